"""What stands for the meshes of links: hulls, distances, pieces, nothing; Collada's units and nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from robots.test_files import BODY, joint, link

import dano
from dano.fields import hull_field
from dano.robots.formats import read_collada

trimesh = pytest.importorskip("trimesh")
igl = pytest.importorskip("igl")


@pytest.fixture
def corner(tmp_path, monkeypatch):
    """An L of two bars, open at one face, in a robot's file."""
    monkeypatch.setenv("DANO_CACHE_DIR", str(tmp_path / "cache"))
    outline = [(0, 0), (0.3, 0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)]
    front = [(x, y, z) for z in (0.0, 0.1) for x, y in outline]
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ((i, j, j + 6), (i, j + 6, i + 6))]
    faces = [f[::-1] for f in caps] + [tuple(6 + i for i in f) for f in caps] + sides
    trimesh.Trimesh(front, faces).export(tmp_path / "l.stl")
    trimesh.Trimesh(front, faces[1:]).export(tmp_path / "open.stl")

    def robot(name="l.stl", scale="1 1 1", **options):
        mesh = f'<collision><geometry><mesh filename="{name}" scale="{scale}"/></geometry></collision>'
        path = tmp_path / "robot.urdf"
        path.write_text(f'<robot name="r">{link("a")}{link("b", BODY + mesh)}{joint("j", "a", "b")}</robot>')
        return dano.load_urdf(path, **options)

    return robot


# In the notch, and in one of the bars.
NOTCH, BAR = (0.12, 0.12, 0.05), (0.25, 0.05, 0.05)


def distance(robot, point):
    return float(robot.bodies[0].shape.sdf(jnp.array(point)))


def test_choices_for_meshes(corner):
    """In the notch of an L its hull is solid, its own distance is not; for one link or for all."""
    for word in (True, "hull"):
        assert distance(corner(collision=word), NOTCH) < -0.01
    assert distance(corner(collision="distance"), NOTCH) == pytest.approx(0.02, abs=3e-3)
    assert distance(corner(collision={"b": "distance"}), BAR) == pytest.approx(-0.05, abs=3e-3)
    for word in (False, "none", {"b": "none"}):
        assert corner(collision=word).touching == ()
    # A face that is missing does not matter to a hull.
    assert distance(corner("open.stl"), NOTCH) < -0.01
    with pytest.raises(
        ValueError, match=r"collision must be one of \['hull', 'distance', 'pieces', 'none'\]"
    ):
        corner(collision="mesh")
    with pytest.raises(ValueError, match="got 'c'"):
        corner(collision={"c": "hull"})


def test_pieces_follow_a_notch(corner, tmp_path):
    pytest.importorskip("coacd")
    robot = corner(collision="pieces")
    assert distance(robot, NOTCH) > 0.01
    assert distance(robot, BAR) < -0.03
    kept = next((tmp_path / "cache" / "meshes").iterdir())
    stamp = kept.stat().st_mtime_ns
    assert distance(corner(collision="pieces"), NOTCH) > 0.01
    assert kept.stat().st_mtime_ns == stamp


@pytest.mark.filterwarnings("ignore:link 'b'.*four numbers:UserWarning")
def test_scales_of_meshes(corner):
    """Mirrored, different along the axes, one number for all, and four."""
    assert distance(corner(scale="1 -1 1", collision="distance"), (0.12, -0.12, 0.05)) == pytest.approx(
        0.02, abs=3e-3
    )
    assert distance(corner(scale="2 1 1"), (0.55, 0.05, 0.05)) == pytest.approx(-0.05, abs=3e-3)
    assert distance(corner(scale="2"), (0.5, 0.1, 0.1)) == pytest.approx(-0.1, abs=6e-3)
    with pytest.warns(UserWarning, match="of the four numbers of a scale the first three count"):
        assert distance(corner(scale="1 1 1 1"), BAR) < 0
    with pytest.raises(ValueError, match="scale of a mesh must not be 0"):
        corner(scale="1 1 0")


@pytest.mark.parametrize("mesh", ["ball", "box", "plate"])
def test_hull_is_the_signed_distance_of_the_hull(mesh):
    """Against libigl on the hull of all points, to a fifth of a cell, though fewer corners are kept."""
    made = {
        "ball": lambda: trimesh.creation.icosphere(5, 0.1),
        "box": lambda: trimesh.creation.box((0.3, 0.2, 0.1)),
        "plate": lambda: trimesh.creation.box((0.3, 0.2, 0.004)),
    }[mesh]()
    shape = hull_field(np.asarray(made.vertices))
    cells = 2 * float(shape.spacing[0]) * np.array([[-1.0], [1.0]])
    points = np.random.default_rng(0).uniform(*(made.bounds + cells), size=(500, 3))
    found = np.asarray(jax.vmap(shape.sdf)(jnp.asarray(points)))
    expected = igl.signed_distance(
        points, np.asarray(made.vertices, float), np.asarray(made.faces, np.int64)
    )[0]
    # Where the spline rounds edges off it errs by more than on faces.
    assert np.percentile(np.abs(found - expected), 90) < 0.2 * float(shape.spacing[0])
    assert np.abs(found - expected).max() < 0.5 * float(shape.spacing[0])
    assert shape.moments is not None
    np.testing.assert_allclose(shape.moments.volume, made.volume, rtol=0.01)
    with pytest.raises(ValueError, match="points must span a volume"):
        hull_field(np.eye(4)[:, :3] * [1, 1, 0])


COLLADA = """ <?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="15">0 0 0 10 0 0 10 10 0 0 10 0 99 99 99</float_array>
<technique_common><accessor source="#pa" count="5" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<source id="n"><float_array id="na" count="3">0 0 1</float_array>
<technique_common><accessor source="#na" count="1" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="1"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#n" offset="1"/>
<vcount>4</vcount><p>0 0 1 0 2 0 3 0</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>100 0 0</translate><rotate>0 0 1 90</rotate>
<node><matrix>2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#g"/></node></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""

EMPTY = COLLADA.replace("<vcount>4</vcount><p>0 0 1 0 2 0 3 0</p>", "<vcount></vcount><p></p>").replace(
    'count="1"', 'count="0"'
)
BROKEN = COLLADA.replace("accessor", "excessor")
MIRRORED = COLLADA.replace("<matrix>2", "<matrix>-2")


def test_collada(tmp_path):
    """Units and places of nodes count, points of no face do not: a tile of 0.1 m, turned and stretched."""
    path = tmp_path / "tile.dae"
    path.write_text(COLLADA)
    vertices, faces = read_collada(path)
    np.testing.assert_allclose(vertices, [[1, 0, 0], [1, 0.2, 0], [0.9, 0.2, 0], [0.9, 0, 0]], atol=1e-7)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    path.write_text(MIRRORED)
    assert read_collada(path)[1].tolist() == [[2, 1, 0], [3, 2, 0]]
    for text, message in (
        ("<COLLADA", "cannot be read"),
        ("<a/>", ""),
        ("<COLLADA/>", ""),
        (EMPTY, "got none"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"must be a Collada file.*{message}"):
            read_collada(path)
