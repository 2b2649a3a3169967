"""What a scene file may say."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.scene_file import load_asset, load_run, load_scene, parse_scene, save_run

# Scenes here are odd on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::dano.scene.SceneWarning")


def test_defaults_and_all_pairs(scene):
    text = scene.read_text(encoding="utf-8").split("[[contacts]]")[0]
    text += """
[default_contact]
restitution = 0.4
stiction_velocity = 1e-6

[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.05
mass = 2
velocity = [1, 0, 0]

[[bodies]]
name = "wall"
shape = "half_space"
normal = [1.0, 0.0, 0.0]
offset = -1.0
fixed = true
"""
    loaded = parse_scene(text, scene)
    pairs = [(contact.a, contact.b) for contact in loaded.scene.contacts]
    assert pairs == [("egg", "floor"), ("egg", "ball"), ("egg", "wall"), ("floor", "ball"), ("ball", "wall")]
    for contact in loaded.scene.contacts:
        assert isinstance(contact.law, dano.DistributedLaw)
        assert float(contact.law.stiction_velocity) == 1e-6
        assert float(contact.params.restitution) == 0.4
        assert float(contact.params.hysteresis) == 0.35
        assert contact.params.spring is None
    assert loaded.n_steps == 400
    assert loaded.controls is None
    np.testing.assert_allclose(loaded.scene.gravity, (0, 0, -9.81))
    np.testing.assert_allclose(loaded.state.velocity[2], (1, 0, 0))
    np.testing.assert_allclose(loaded.state.omega[0], (0, 0, 1))


def test_centroid_law(scene):
    text = scene.read_text(encoding="utf-8").split("[[contacts]]")[0]
    text += """
[default_contact]
law = "centroid"
rolling_friction = 0.002
smoothing = 500
"""
    (contact,) = parse_scene(text, scene).scene.contacts
    assert isinstance(contact.law, dano.CentroidLaw)
    assert float(contact.law.smoothing) == 500
    assert float(contact.params.rolling_friction) == 0.002
    assert float(contact.params.spring) == 3e4
    # Files from before the distributed law was the default.
    before = text.replace('law = "centroid"\n', "")
    (contact,) = parse_scene(before, scene, default_law="centroid").scene.contacts
    assert isinstance(contact.law, dano.CentroidLaw)
    with pytest.raises(ValueError, match="default_law must be one of centroid, distributed, got 'glue'"):
        parse_scene(before, scene, default_law="glue")


def test_distributed_law(scene):
    text = scene.read_text(encoding="utf-8").split("[[contacts]]")[0]
    text += """
[default_contact]
law = "distributed"
sliding_friction = 0.3
stiffness = 4e8
restitution = 0.5
restitution_velocity = 0.02
hysteresis = 0.1
friction_fading = 0.4
friction_pressure = 2e3
stiction_velocity = 1e-6
compliant = true
"""
    (contact,) = parse_scene(text, scene).scene.contacts
    assert isinstance(contact.law, dano.DistributedLaw)
    assert float(contact.law.stiction_velocity) == 1e-6
    assert contact.law.compliant is True
    expected = {
        "sliding_friction": 0.3,
        "stiffness": 4e8,
        "restitution": 0.5,
        "restitution_velocity": 0.02,
        "hysteresis": 0.1,
        "friction_fading": 0.4,
        "friction_pressure": 2e3,
    }
    assert {key: float(getattr(contact.params, key)) for key in expected} == expected
    (contact,) = parse_scene(text.replace("stiffness = 4e8\n", ""), scene).scene.contacts
    assert contact.params.stiffness is not None and float(contact.params.stiffness) > 0
    (contact,) = parse_scene(text.replace("compliant = true", ""), scene).scene.contacts
    assert isinstance(contact.law, dano.DistributedLaw) and contact.law.compliant is False


def test_contact_with_another_law_than_the_default(scene):
    text = scene.read_text(encoding="utf-8").split("[[contacts]]")[0]
    text += """
[[bodies]]
name = "ball"
shape = "sphere"
radius = 0.05
mass = 2
position = [0, 0, 0.2]

[default_contact]
law = "distributed"
sliding_friction = 0.3
restitution = 0.5

[[contacts]]
a = "egg"
b = "floor"

[[contacts]]
a = "ball"
b = "floor"
law = "centroid"
stiction_velocity = 1e-6
"""
    egg, ball = parse_scene(text, scene).scene.contacts
    assert isinstance(egg.law, dano.DistributedLaw)
    assert float(egg.params.restitution) == 0.5
    assert isinstance(ball.law, dano.CentroidLaw)
    assert ball.law.stiction_velocity is not None and float(ball.law.stiction_velocity) == 1e-6
    # What the default says for its own law is not for this one.
    assert ball.params.restitution is None
    assert float(ball.params.sliding_friction) == 0.3


SHAPES = {
    'shape = "box"\nhalf_extents = [0.1, 0.2, 0.3]\nrounding = 0.01': dano.Box((0.1, 0.2, 0.3), 0.01),
    'shape = "capsule"\nradius = 0.1\nhalf_length = 0.2\nedge = 0.001': dano.Capsule(0.1, 0.2, edge=0.001),
    'shape = "cylinder"\nradius = 0.1\nhalf_length = 0.2': dano.Cylinder(0.1, 0.2),
    'shape = "ellipsoid"\nsemi_axes = [0.1, 0.2, 0.3]': dano.Ellipsoid((0.1, 0.2, 0.3)),
    'shape = "sphere"\nradius = 0.1\npose = {position = [0, 0.1, 0]}': dano.posed(
        dano.Sphere(0.1), dano.Pose((0, 0.1, 0))
    ),
}


@pytest.mark.parametrize("text", SHAPES, ids=lambda text: text.split('"')[1])
def test_shapes(text, tmp_path):
    loaded = parse_scene(f'n_steps = 1\n[[bodies]]\nname = "it"\nmass = 1.5\n{text}\n', tmp_path / "s.toml")
    shape, expected = loaded.scene.body("it").shape, SHAPES[text]
    assert shape is not None and type(shape) is type(expected)
    for x in (jnp.array([0.05, 0.1, 0.15]), jnp.array([0.1, -0.05, 0.0])):
        assert float(shape.sdf(x)) == pytest.approx(float(expected.sdf(x)), abs=1e-12)
    assert float(shape.edge_width) == float(expected.edge_width)
    assert float(loaded.scene.body("it").mass) == 1.5


def test_field_is_built_and_shared(field, tmp_path):
    body = f'field = "{field.name}"\nmass = 0.3\nbuild = {{samples = 100, resolution = 16, length = 0.2}}'
    text = (
        f'duration = 0.5\n[[bodies]]\nname = "a"\n{body}\n[[bodies]]\nname = "b"\n{body}\nmass_scale = 2.0\n'
    )
    loaded = parse_scene(text, field.parent / "scene.toml")
    a, b = loaded.scene.bodies
    assert a.object is not None and b.object is not None
    assert a.object.samples.points is b.object.samples.points
    assert loaded.scene.twins == (0, 0)
    assert a.size == pytest.approx(0.2, rel=0.03)
    assert (float(a.mass), float(b.mass * b.mass_scale)) == (pytest.approx(0.3), pytest.approx(0.6))
    assert loaded.n_steps == 50


def test_controls_push_and_pull(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(
        """
timestep = 0.01
n_steps = 100
gravity = [0.0, 0.0, 0.0]
contacts = []
[[bodies]]
name = "pushed"
shape = "sphere"
radius = 0.1
mass = 2.0
[[bodies]]
name = "pulled"
shape = "box"
half_extents = [0.1, 0.1, 0.1]
mass = 1.0
position = [1.0, 0.0, 0.0]
[[controls]]
body = "pushed"
force = [4.0, 0.0, 0.0]
torque = [0.0, 0.0, 0.008]
from = 0.1
to = 0.35
[[controls]]
body = "pulled"
target = [1.0, 0.5, 0.0]
stiffness = 100.0
damping = 20.0
""",
        encoding="utf-8",
    )
    loaded = load_scene(path)
    assert loaded.scene.contacts == ()
    run = dano.simulate(loaded.scene, loaded.state, loaded.n_steps, controls=loaded.controls)
    # Impulse over mass: 4 N for 0.25 s on 2 kg, 0.008 N m on 2/5 m r² = 0.008 kg m².
    np.testing.assert_allclose(run.states.velocity[-1, 0], (0.5, 0, 0), atol=1e-9)
    np.testing.assert_allclose(run.states.omega[-1, 0], (0, 0, 0.25), atol=1e-3)
    np.testing.assert_allclose(run.states.velocity[10, 0], 0, atol=1e-12)
    assert float(run.states.velocity[11, 0, 0]) > 0
    # A critically damped spring of 10 rad/s, which moves at most as far as asked.
    assert float(run.states.position[-1, 1, 1]) == pytest.approx(0.5, abs=5e-3)
    # The second half alone, told when it begins, goes on as the whole did.
    assert loaded.controls is not None
    middle = dano.State(*(x[20] for x in (run.states.position, run.states.orientation, *_velocities(run))))
    rest = dano.simulate(loaded.scene, middle, 100, controls=loaded.controls.starting_at(0.2))
    np.testing.assert_allclose(rest.states.position[80], run.states.position[100], atol=1e-10)


def _velocities(run):
    return run.states.velocity, run.states.omega


def test_assets_are_real():
    soap = load_asset("soap")
    assert load_asset("soap") is soap
    assert dano.load_object("soap") is soap
    np.testing.assert_allclose(np.ptp(soap.samples.points, axis=0), (0.09, 0.06, 0.03), atol=0.003)
    # A bar of uniform density weighs m/12 (b² + c²) about its long axis; rounded edges take 5 %.
    assert float(soap.mass.mass) == pytest.approx(0.15)
    expected = 0.15 / 12 * np.array([0.06**2 + 0.03**2, 0.09**2 + 0.03**2, 0.09**2 + 0.06**2])
    np.testing.assert_allclose(np.diag(soap.mass.inertia), expected, rtol=0.1)


BODY = '[[bodies]]\nname = "ball"\nshape = "sphere"\nradius = 0.1\nmass = 1.0\n'
FLOOR = '[[bodies]]\nname = "floor"\nshape = "half_space"\nfixed = true\n'
BAD = {
    "no TOML": ("n_steps = ", "must be a TOML scene file"),
    "unknown key": ("n_steps = 1\nspeed = 2\n" + BODY, "unknown key 'speed'; valid keys are timestep"),
    "no length": (BODY, "either duration [s] or n_steps"),
    "both lengths": ("n_steps = 1\nduration = 1.0\n" + BODY, "say the same"),
    "long": ("duration = 1e9\n" + BODY, "steps of 1 bodies, got 1e+11 of 0.01 s"),
    "endless": ("timestep = 1e-300\nduration = 1e300\n" + BODY, "steps of 1 bodies, got inf of"),
    "zero steps": ("n_steps = 0\n" + BODY, "n_steps must be ≥ 1, got 0"),
    "negative timestep": (
        "n_steps = 1\ntimestep = -0.1\n" + BODY,
        "timestep must be finite and > 0 s, got -0.1",
    ),
    "wrong type": ('n_steps = "many"\n' + BODY, "n_steps must be a whole number, got 'many'"),
    "no camera file": ("n_steps = 1\ncamera = 3\n" + BODY, "camera must be a non-empty string, got 3"),
    "no body": ("n_steps = 1\n", "at least one [[bodies]] table"),
    "nameless body": (
        'n_steps = 1\n[[bodies]]\nshape = "sphere"\n',
        "[[bodies]] 1: name must be a non-empty string",
    ),
    "unknown body key": (
        "n_steps = 1\n" + BODY + "radus = 1\n",
        "[[bodies]] 1 ('ball'): unknown key 'radus'; valid keys are ",
    ),
    "key nearly right": ("n_steps = 1\n" + BODY + "radus = 1\n", "; did you mean 'radius'?"),
    "key of other programs": ("n_steps = 1\n" + BODY + "size = 1\n", "; did you mean 'radius'?"),
    "shape nearly right": (
        'n_steps = 1\n[[bodies]]\nname = "x"\nshape = "shpere"\n',
        "got 'shpere'; did you mean 'sphere'?",
    ),
    "body nearly right": (
        "n_steps = 1\n" + BODY + FLOOR + '[[contacts]]\na = "ball"\nb = "flor"\n',
        "got 'flor'; did you mean 'floor'?",
    ),
    "asset nearly right": (
        'n_steps = 1\n[[bodies]]\nname = "x"\nasset = "Bunny"\n',
        "got 'Bunny'; did you mean 'bunny'?",
    ),
    "unknown shape": (
        'n_steps = 1\n[[bodies]]\nname = "x"\nshape = "cone"\n',
        "shape must be one of 'half_space'",
    ),
    "shape without size": (
        'n_steps = 1\n[[bodies]]\nname = "x"\nshape = "box"\n',
        "a box needs half_extents",
    ),
    "two geometries": (
        "n_steps = 1\n" + BODY + 'asset = "soap"\n',
        "needs exactly one of object, field, asset",
    ),
    "no geometry": ('n_steps = 1\n[[bodies]]\nname = "x"\n', "needs exactly one of object, field, asset"),
    "unknown asset": (
        'n_steps = 1\n[[bodies]]\nname = "x"\nasset = "cow"\n',
        "asset must be one of ['bunny', 'soap', 'trained_bunny', 'trained_soap']",
    ),
    "no mass": ("n_steps = 1\n" + BODY.replace("mass = 1.0\n", ""), "mass of body 'ball' must be given"),
    "two names": ("n_steps = 1\n" + BODY + BODY, "bodies must have different names, got 'ball' 2 times"),
    "infinite position": (
        "n_steps = 1\n" + BODY + "position = [inf, 0, 0]\n",
        "position must be a list of 3 finite",
    ),
    "zero quaternion": (
        "n_steps = 1\n" + BODY + "orientation = [0, 0, 0, 0]\n",
        "must be a non-zero quaternion",
    ),
    "short vector": (
        "n_steps = 1\n" + BODY + "velocity = [1, 2]\n",
        "velocity must be a list of 3 finite numbers",
    ),
    "unknown body in contact": (
        "n_steps = 1\n" + BODY + '[[contacts]]\na = "ball"\nb = "flor"\n',
        "[[contacts]] 1 ('ball', 'flor'): a contact must name bodies of the scene ['ball'], got 'flor'",
    ),
    "negative friction": (
        "n_steps = 1\n" + BODY + FLOOR + '[[contacts]]\na = "ball"\nb = "floor"\nsliding_friction = -0.2\n',
        "[[contacts]] 1 ('ball', 'floor'): sliding_friction must be finite and ≥ 0, got -0.2",
    ),
    "negative default friction": (
        "n_steps = 1\n" + BODY + FLOOR + "[default_contact]\nsliding_friction = -1.0\n",
        "[default_contact]: sliding_friction must be finite and ≥ 0",
    ),
    "unknown law": (
        "n_steps = 1\n" + BODY + FLOOR + '[[contacts]]\na = "ball"\nb = "floor"\nlaw = "glue"\n',
        "[[contacts]] 1 ('ball', 'floor'): law must be one of 'centroid', 'distributed', got 'glue'",
    ),
    "key of the other law": (
        "n_steps = 1\n" + BODY + FLOOR + '[default_contact]\nlaw = "distributed"\nsmoothing = 100\n',
        "[default_contact]: smoothing belongs to law = 'centroid', and this is 'distributed', whose keys are",
    ),
    "parameter of the other law": (
        "n_steps = 1\n"
        + BODY
        + FLOOR
        + '[[contacts]]\na = "ball"\nb = "floor"\nlaw = "distributed"\nrolling_friction = 0.01\n',
        "[[contacts]] 1 ('ball', 'floor'): rolling_friction belongs to law = 'centroid'",
    ),
    "parameter of a law not chosen": (
        "n_steps = 1\n" + BODY + FLOOR + "[default_contact]\nspring = 1e4\n",
        "for the other law write law = 'centroid'",
    ),
    "compliant as a number": (
        "n_steps = 1\n" + BODY + FLOOR + '[default_contact]\nlaw = "distributed"\ncompliant = 1\n',
        "[default_contact]: compliant must be true or false",
    ),
    "compliant with the paper's law": (
        "n_steps = 1\n" + BODY + FLOOR + '[default_contact]\nlaw = "centroid"\ncompliant = true\n',
        "[default_contact]: compliant belongs to law = 'distributed'",
    ),
    "restitution above one": (
        "n_steps = 1\n" + BODY + FLOOR + '[default_contact]\nlaw = "distributed"\nrestitution = 1.5\n',
        "[default_contact]: restitution must lie in [0, 1], got 1.5",
    ),
    "no stiction": (
        "n_steps = 1\n" + BODY + FLOOR + "[default_contact]\nstiction_velocity = 0\n",
        "[default_contact]: stiction_velocity must be > 0, got 0.0",
    ),
    "unknown body in control": ("n_steps = 1\n" + BODY + '[[controls]]\nbody = "bal"\n', "got 'bal'"),
    "control of a fixed body": (
        "n_steps = 1\n" + BODY + FLOOR + '[[controls]]\nbody = "floor"\n',
        "fixed 'floor'",
    ),
    "control that ends first": (
        "n_steps = 1\n" + BODY + '[[controls]]\nbody = "ball"\nfrom = 2\nto = 1\n',
        "from and to must satisfy",
    ),
    "target without spring": (
        "n_steps = 1\n" + BODY + '[[controls]]\nbody = "ball"\ntarget = [0, 0, 0]\n',
        "target [m] and stiffness [N/m] must be given together",
    ),
    "missing object": ('n_steps = 1\n[[bodies]]\nname = "x"\nobject = "no.dano"\n', "no.dano"),
    "missing field": ('n_steps = 1\n[[bodies]]\nname = "x"\nfield = "no.npz"\n', "no.npz"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_scene_files(case, tmp_path, run):
    text, message = BAD[case]
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    answer = run("simulate", path, "-o", tmp_path / "run.npz")
    assert answer.code == 2
    assert answer.out == ""
    assert answer.err.startswith(f"dano: error: {path}")
    assert answer.err.count("\n") == 1
    assert message in answer.err
    assert list(tmp_path.iterdir()) == [path]


def test_run_without_its_scene(tmp_path):
    path = tmp_path / "run.npz"
    zeros = jnp.zeros((2, 1, 3))
    states = dano.State(zeros, jnp.zeros((2, 1, 4)), zeros, zeros)
    steps = jnp.zeros(1), jnp.zeros(1, int), jnp.zeros(1, bool)
    dano.Trajectory(jnp.zeros(2), states, *steps, ("x",)).save(path)
    with pytest.raises(ValueError, match="does not say which scene"):
        load_run(path)


def test_run_from_before_the_distributed_law_was_the_default(tmp_path):
    path, zeros = tmp_path / "run.npz", jnp.zeros((2, 2, 3))
    text = "n_steps = 1\n" + BODY + FLOOR + "[default_contact]\nsmoothing = 100.0\n"
    source = {"scene": text, "path": str(tmp_path / "scene.toml")}
    states = dano.State(zeros, jnp.zeros((2, 2, 4)), zeros, zeros)
    steps = jnp.zeros(1), jnp.zeros(1, int), jnp.ones(1, bool)
    dano.Trajectory(jnp.zeros(2), states, *steps, ("ball", "floor")).save(path, source=json.dumps(source))
    (contact,) = load_run(path).scene.contacts
    assert isinstance(contact.law, dano.CentroidLaw) and float(contact.law.smoothing) == 100
    # What is saved now says it.
    loaded = parse_scene(text.replace("smoothing = 100.0", "restitution = 0.5"), tmp_path / "scene.toml")
    save_run(path, dano.simulate(loaded.scene, loaded.state, 1), loaded)
    (contact,) = load_run(path).scene.contacts
    assert isinstance(contact.law, dano.DistributedLaw) and float(contact.params.restitution) == 0.5


def test_documented_scene_loads(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "scenes.md").read_text(encoding="utf-8")
    text = "\n".join(block.split("```")[0] for block in page.split("```toml\n")[1:])
    loaded = parse_scene(text, tmp_path / "soap.toml")
    assert loaded.scene.names == ("soap", "ball", "floor", "door")
    assert [joint.child for joint in loaded.scene.joints] == ["door"]
    assert loaded.n_steps == 300
    assert loaded.controls is not None


def test_byte_order_mark(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("n_steps = 1\n" + BODY, encoding="utf-8-sig")
    assert load_scene(path).scene.names == ("ball",)


JOINTED = """
timestep = 0.005
n_steps = 3
[[bodies]]
name = "door"
shape = "box"
half_extents = [0.04, 0.01, 0.05]
mass = 0.2
q = -0.4
v = 3.0
[[bodies]]
name = "knob"
shape = "sphere"
radius = 0.01
mass = 0.01
[[bodies]]
name = "floor"
shape = "half_space"
fixed = true
[[joints]]
child = "door"
anchor = [-0.04, 0, 0]
position = [0, 0, 0.06]
damping = 0.1
[[joints]]
parent = "door"
child = "knob"
kind = "weld"
position = [0.03, 0.02, 0]
[[controls]]
body = "door"
effort = 0.5
"""


def test_joints_of_a_scene_file(tmp_path):
    """Places, coordinates, efforts; bodies that are joined do not touch."""
    path = tmp_path / "door.toml"
    path.write_text(JOINTED)
    loaded = load_scene(path)
    assert loaded.state.q is not None
    assert loaded.state.v is not None
    assert (float(loaded.state.q[0]), float(loaded.state.v[0])) == (-0.4, 3.0)
    np.testing.assert_allclose(
        loaded.state.position[0], [-0.04 + 0.04 * np.cos(0.4), -0.04 * np.sin(0.4), 0.06], atol=1e-12
    )
    pairs = {frozenset((contact.a, contact.b)) for contact in loaded.scene.contacts}
    assert pairs == {frozenset(("door", "floor")), frozenset(("knob", "floor"))}
    assert loaded.controls is not None
    effort = loaded.controls(loaded.state, jnp.zeros(())).effort
    assert effort is not None
    np.testing.assert_allclose(effort, [0.5])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('child = "knob"', 'child = "nob"', "'nob'; did you mean 'knob'"),
        ('kind = "weld"', 'kind = "screw"', "kind must be one of 'hinge', .*, got 'screw'"),
        ("damping = 0.1", "damping = -1", "damping of the joint of 'door' must be ≥ 0"),
        ('body = "door"', 'body = "knob"', "effort needs a body on a hinge or a slide"),
        ("q = -0.4", "position = [0, 0, 1]", "must be given by .'q', 'v'., for it hangs on a joint"),
        ("q = -0.4", 'q = "open"', "q must be a finite number"),
    ],
)
def test_wrong_joints_of_a_scene_file(tmp_path, old, new, message):
    path = tmp_path / "door.toml"
    path.write_text(JOINTED.replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_scene(path)


def test_objects_by_name_or_file(egg, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.testing.assert_array_equal(dano.load_object(egg).mass.com, dano.NeuralObject.load(egg).mass.com)
    with pytest.raises(
        ValueError, match=r"source must be a \.dano file or one of \['bunny', .*; did you mean 'bunny'"
    ):
        dano.load_object("buny")
    with pytest.raises(ValueError, match="must be an existing file, got none.dano"):
        dano.load_object("none.dano")
    # A file of the user's goes before what is shipped.
    (tmp_path / "soap").write_bytes(egg.read_bytes())
    np.testing.assert_array_equal(dano.load_object("soap").mass.com, dano.load_object(egg).mass.com)


def test_a_place_is_said_once():
    text = 'n_steps = 1\n[[bodies]]\nname = "a"\nshape = "sphere"\nraduis = 0.1\n'
    with pytest.raises(ValueError, match="unknown key 'raduis'") as caught:
        parse_scene(text, Path("s.toml"))
    assert str(caught.value).count("s.toml: [[bodies]]") == 1
