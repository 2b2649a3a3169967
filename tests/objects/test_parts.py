"""Objects of several parts, against sums in closed form."""

import warnings

import numpy as np
import pytest

import dano
from dano.building import BuildOptions
from dano.scene_file import materials_doubt, part_of, parts_of

QUICK = BuildOptions(samples=200, resolution=32)


def box(half, centre):
    return dano.posed(dano.Box(half), dano.Pose(centre, (1, 0, 0, 0)))


@pytest.fixture(scope="module")
def hammer():
    """A steel head of 80 × 20 × 20 mm on a wooden handle of 20 × 20 × 200 mm, and their union."""
    head, handle = box((0.04, 0.01, 0.01), (0, 0, 0.11)), box((0.01, 0.01, 0.1), (0, 0, 0))
    return dano.build_parts([dano.Part(head, density=7800), dano.Part(handle, mass=0.05)], QUICK)


def test_mass_centre_inertia_are_those_of_two_boxes(hammer):
    m = np.array([7800 * 0.08 * 0.02 * 0.02, 0.05])
    z = np.array([0.11, 0.0])
    sides = np.array([[0.08, 0.02, 0.02], [0.02, 0.02, 0.2]])
    own = m[:, None] / 12 * (np.sum(sides**2, axis=1, keepdims=True) - sides**2)
    centre = m @ z / m.sum()
    moments = own.sum(axis=0) + np.sum(m * (z - centre) ** 2) * np.array([1, 1, 0])
    assert np.isclose(hammer.mass.mass, m.sum(), rtol=1e-5)
    assert np.allclose(hammer.mass.com, [0, 0, centre], atol=1e-6)
    assert np.allclose(hammer.mass.inertia, np.diag(moments), atol=1e-4 * moments.max())
    assert hammer.mass_model == "given" and "sum of 2 parts" in hammer.mass_reason


def test_its_surface_is_that_of_the_union(hammer):
    low, high = (f(np.asarray(hammer.surface.points), axis=0) for f in (np.min, np.max))
    assert np.allclose(high - low, [0.08, 0.02, 0.22], atol=3e-3)
    # Where the two meet is no surface.
    between = np.abs(np.asarray(hammer.surface.points) - [0, 0, 0.1]).max(axis=1) < 0.005
    assert not between.any()


def test_words_of_the_command_line():
    assert part_of("grip.ply:1100") == dano.Part("grip.ply", density=1100)
    assert part_of("grip.ply:0.3kg") == dano.Part("grip.ply", mass=0.3)
    assert part_of("grip.ply:300g") == dano.Part("grip.ply", mass=0.3)
    assert part_of("grip.ply") is None and parts_of(["grip.ply"]) == []
    with pytest.raises(ValueError, match=r"b\.ply needs a density .* b\.ply:7850 or b\.ply:0\.3kg"):
        parts_of(["a.ply:7850", "b.ply"])


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({}, "needs either a density"),
        (dict(density=1.0, mass=1.0), "needs either a density"),
        (dict(density=7.85), "must be in kg/m³, from 10 to 30000"),
        (dict(density=-1.0), "density of a.ply must be"),
        (dict(mass=0.0), "mass of a.ply must be"),
    ],
)
def test_a_part_without_a_sensible_weight_is_refused(part, words):
    with pytest.raises(ValueError, match=words):
        dano.Part("a.ply", **part)


def test_parts_that_overlap_are_refused():
    parts = [dano.Part(box((0.05,) * 3, (0, 0, z)), density=1000) for z in (0.0, 0.05)]
    with pytest.raises(ValueError, match=r"overlap: (49|50|51) % of PosedShape"):
        dano.build_parts(parts, QUICK)


def test_parts_that_do_not_touch_are_said():
    parts = [dano.Part(box((0.05,) * 3, (0, 0, z)), density=1000) for z in (0.0, 0.2)]
    with pytest.warns(UserWarning, match="does not touch the other parts"):
        made = dano.build_parts(parts, QUICK)
    assert np.isclose(made.mass.mass, 2.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("parts", "options", "words"),
    [
        ([], QUICK, "at least one part"),
        ([dano.Part(dano.HalfSpace(), density=1000)], QUICK, "must be bounded"),
        ([dano.Part(dano.Sphere(0.1), density=1000)], BuildOptions(mass=1.0), "leave out mass"),
    ],
)
def test_what_does_not_fit_is_refused(parts, options, words):
    with pytest.raises(ValueError, match=words):
        dano.build_parts(parts, options)


def test_meshes_are_read_in_one_unit(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="needs the extra mesh")
    # 15 mm alone would be read as 15 m.
    for name, sides, at in (("long", (10, 10, 60), 0.0), ("short", (15, 15, 10), 35.0)):
        trimesh.creation.box(sides).apply_translation((0, 0, at)).export(tmp_path / f"{name}.stl")
    parts = [dano.Part(tmp_path / "long.stl", density=1000), dano.Part(tmp_path / "short.stl", mass=0.1)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = dano.build_parts(parts, QUICK)
    assert any("all parts are read in millimetres" in str(each.message) for each in caught)
    assert np.isclose(made.mass.mass, 0.106, rtol=1e-5)
    assert np.allclose(made.mass.com, [0, 0, 0.1 * 0.035 / 0.106], atol=1e-6)


def test_parts_of_other_colours_are_asked_for(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="needs the extra mesh")
    pieces = []
    for sides, at, colour in (((20, 20, 200), 0.0, (150, 90, 40)), ((80, 20, 20), 115.0, (60, 60, 60))):
        piece = trimesh.creation.box(sides).apply_translation((0, 0, at))
        piece.visual.vertex_colors = (*colour, 255)
        pieces.append(piece)
    trimesh.util.concatenate(pieces).export(tmp_path / "hammer.ply")
    text = materials_doubt(tmp_path / "hammer.ply")
    # 80 and 32 cm³ at 0 and 115 mm, of 225 mm: 115·(32·7850/(80·1100 + 32·7850) − 32/112) mm.
    expected = 100 * 115 * (32 * 7850 / (80 * 1100 + 32 * 7850) - 32 / 112) / 225
    assert text is not None and f"off by {expected:.0f} % of the size" in text
    for piece in pieces:
        piece.visual.vertex_colors = (60, 60, 60, 255)
    trimesh.util.concatenate(pieces).export(tmp_path / "plain.ply")
    assert materials_doubt(tmp_path / "plain.ply") is None
