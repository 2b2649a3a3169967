"""What is said of bad input through the Python interface; `python -m tests.fuzz` tries much more."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dano
from dano.fields import load_field, save_field

FLOOR = dano.Body("floor", dano.HalfSpace(), fixed=True)


def ball(name: str = "ball") -> dano.Body:
    return dano.Body(name, dano.Sphere(0.1), mass=1.0)


def scene() -> dano.Scene:
    return dano.Scene.create([ball(), FLOOR], [dano.Contact("ball", "floor")], timestep=0.01)


def grid(value: float | None = None) -> dano.GridField:
    values = np.zeros((8, 8, 8))
    values[2:6, 2:6, 2:6] = 50.0
    if value is not None:
        values[3, 3, 3] = value
    return dano.GridField(values, (0.0, 0.0, 0.0), 0.01)


def built(field: dano.AbstractField, **options) -> dano.NeuralObject:
    return dano.NeuralObject.from_field(field, **{"n_samples": 50, "resolution": 8, **options})


def cloud(n: int) -> dano.NeuralObject:
    """An object of n samples on a ball, without a field."""
    points = np.random.default_rng(0).normal(size=(n, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
    return dano.NeuralObject.from_samples(
        points=points, density=np.ones(n), mass=1.0, com=(0, 0, 0), inertia=1e-3 * np.eye(3)
    )


def two_clouds(law: dano.AbstractContactLaw | None) -> dano.Scene:
    bodies = [dano.Body("a", cloud(9)), dano.Body("b", cloud(9))]
    return dano.Scene.create(bodies, [dano.Contact("a", "b", law=law)])


class Spoilt(dano.AbstractField):
    """A density that is wrong somewhere, as a user's own function may be."""

    value: float

    @property
    def bounds(self):
        return jnp.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])

    def density(self, x):
        return jnp.where(jnp.sum(x * x) < 0.5, self.value, 1.0)


class Nothing(Spoilt):
    """Empty space."""

    def density(self, x):
        return jnp.zeros_like(x[0])


def state(**changes) -> dano.State:
    return scene().initial_state(ball=changes)


def with_state(name: str, value: float) -> dano.State:
    good = state()
    return jax.tree.map(lambda x: jnp.full_like(x, value) if x is getattr(good, name) else x, good)


CASES = {
    "NaN on a grid": (lambda: grid(np.nan), "finite"),
    "negative on a grid": (lambda: grid(-1.0), "≥ 0"),
    "empty grid": (lambda: dano.GridField(np.zeros((4, 4, 4)), (0.0, 0.0, 0.0), 0.1), "zero"),
    "NaN density": (lambda: built(Spoilt(float("nan"))), "finite densities, got nan"),
    "negative density": (lambda: built(Spoilt(-2.0)), "densities ≥ 0, got -2.0"),
    "empty field": (lambda: built(Nothing(0.0)), "positive density somewhere"),
    "no sample": (lambda: built(grid(), density_range=(60.0, 70.0)), "density_range"),
    "thin plate": (
        lambda: built(dano.Box((0.1, 0.1, 0.001)), resolution=24),
        "it is 0.003 m thin: try resolution=268, got 24",
    ),
    "more samples than memory": (
        lambda: built(dano.Sphere(0.1), n_samples=10**8),
        "n_samples must be at most 200000, got 100000000",
    ),
    "finer than memory": (lambda: built(dano.Sphere(0.1), resolution=100_000), "resolution must be at most"),
    "range reversed": (lambda: built(grid(), density_range=(2.0, 1.0)), "0 ≤ low < high, got (2.0, 1.0)"),
    "unbounded field": (lambda: built(dano.HalfSpace()), "finite bounds"),
    "body without mass": (lambda: dano.Body("x", dano.Sphere(0.1)), "mass of body 'x' must be given"),
    "field as body": (lambda: dano.Body("x", grid(), mass=1.0), "NeuralObject.from_field"),
    "negative friction": (lambda: dano.ContactParams(sliding_friction=-0.2), "sliding_friction"),
    "infinite spring": (lambda: dano.ContactParams(spring=float("inf")), "spring must be finite"),
    "unknown body": (
        lambda: dano.Scene.create([ball(), FLOOR], [dano.Contact("ball", "flor")]),
        "['ball', 'floor'], got 'flor'",
    ),
    "nearly the name": (
        lambda: dano.Scene.create([ball(), FLOOR], [dano.Contact("ball", "flor")]),
        "did you mean 'floor'?",
    ),
    "inertia of no body": (
        lambda: dano.MassProperties(1.0, (0, 0, 0), np.diag([1.0, 1.0, 5.0])),
        "no principal moment may exceed the sum of the other two, got [1.0, 1.0, 5.0] kg m²",
    ),
    "inertia of a body": (
        lambda: dano.Body("x", dano.Sphere(0.1), mass=1.0, inertia=np.diag([5.0, 1.0, 1.0])),
        "no principal moment may exceed",
    ),
    "two names": (lambda: dano.Scene.create([ball(), ball()]), "different names, got 'ball' 2 times"),
    "pair twice": (
        lambda: dano.Scene.create(
            [ball(), FLOOR], [dano.Contact("ball", "floor"), dano.Contact("floor", "ball")]
        ),
        "each pair once",
    ),
    "nothing to press on": (
        lambda: two_clouds(None),
        "objects 'a' and 'b' by DistributedLaw needs a solid on one side, got solid=None on both: give "
        "NeuralObject.from_samples a field",
    ),
    "nothing to query": (
        lambda: two_clouds(dano.CentroidLaw()),
        "objects 'a' and 'b' by CentroidLaw needs a grid on one side, got grid=None on both: give "
        "NeuralObject.from_samples a field",
    ),
    "samples at one place": (
        lambda: dano.Scene.create([dano.Body("x", cloud(1)), FLOOR], [dano.Contact("x", "floor")]),
        "stiffness and restitution_velocity of the contact between 'x' and 'floor' must be given",
    ),
    "spring without the paper's law": (
        lambda: dano.Contact("a", "b", dano.ContactParams(spring=1e4)),
        "DistributedLaw does not read spring",
    ),
    "no timestep": (lambda: dano.Scene.create([ball()], timestep=0.0), "timestep must be"),
    "infinite position": (lambda: state(position=(0.0, np.inf, 0.0)), "position of 'ball' must be finite"),
    "NaN velocity": (lambda: state(velocity=(np.nan, 0.0, 0.0)), "velocity of 'ball' must be finite"),
    "zero quaternion": (lambda: state(orientation=(0.0, 0.0, 0.0, 0.0)), "non-zero quaternion"),
    "unknown quantity": (lambda: state(speed=(0.0, 0.0, 0.0)), "got 'speed'"),
    "simulate NaN": (lambda: dano.simulate(scene(), with_state("velocity", np.nan), 3), "state.velocity"),
    "step NaN": (lambda: dano.step(scene(), with_state("position", np.inf)), "state.position must be finite"),
    "single precision": (
        lambda: dano.simulate(scene(), jax.tree.map(lambda x: x.astype(jnp.float32), state()), 3),
        "state.position must have the dtype of the scene, float64, got float32: cast it with jax.tree.map",
    ),
    "no steps": (lambda: dano.simulate(scene(), state(), 0), "n_steps must be ≥ 1, got 0"),
    "replaced friction": (
        lambda: scene().replace_contact("ball", "floor", sliding_friction=-1.0),
        "≥ 0, got -1.0",
    ),
    "replaced pair": (lambda: scene().replace_contact("ball", "wall", spring=1.0), "('ball', 'wall')"),
}


def test_keys_of_both_kinds_and_flat_plates_are_taken():
    new, old = (built(grid(), key=key) for key in (jax.random.key(3), jax.random.PRNGKey(3)))
    np.testing.assert_array_equal(new.samples.points, old.samples.points)
    dano.MassProperties(1.0, np.zeros(3, np.float32), np.diag(np.array([0.3, 0.4, 0.7], np.float32)))


@pytest.mark.parametrize("case", CASES)
def test_bad_values(case):
    act, message = CASES[case]
    with pytest.raises(ValueError) as caught:
        act()
    assert message in str(caught.value)


READERS = {"field.npz": load_field, "object.dano": dano.NeuralObject.load, "run.npz": dano.Trajectory.load}


@pytest.mark.parametrize("name", READERS)
def test_bad_files(name, tmp_path):
    good = {"field.npz": lambda path: save_field(grid(), path), "object.dano": built(grid()).save}
    good["run.npz"] = dano.simulate(scene(), state(), 3).save
    path = tmp_path / name
    with pytest.raises(ValueError, match=name):
        READERS[name](path)
    path.mkdir()
    with pytest.raises(ValueError, match=name):
        READERS[name](path)
    path.rmdir()
    good[name](path)
    READERS[name](path)
    whole = path.read_bytes()
    for share in (0.02, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=name):
            READERS[name](path)
    # A spoilt byte in each part of the file: refused, or without effect, but never another error.
    for place in np.linspace(10, len(whole) - 10, 23).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :])
        try:
            READERS[name](path)
        except ValueError as error:
            assert name in str(error)
    for other in READERS:
        if other != name:
            good[other](tmp_path / "other.npz")
            path.write_bytes((tmp_path / "other.npz").read_bytes())
            with pytest.raises(ValueError, match=name):
                READERS[name](path)
    np.save(tmp_path / "bare.npy", np.arange(3))
    path.write_bytes((tmp_path / "bare.npy").read_bytes())
    with pytest.raises(ValueError, match=name):
        READERS[name](path)


@pytest.mark.parametrize("name", READERS)
def test_directory_as_output(name, tmp_path):
    save = {
        "field.npz": lambda path: save_field(grid(), path),
        "object.dano": lambda path: built(grid()).save(path),
        "run.npz": lambda path: dano.simulate(scene(), state(), 3).save(path),
    }[name]
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=name):
        save(tmp_path / name)
    with pytest.raises(ValueError, match="nowhere"):
        save(tmp_path / "nowhere" / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_failed_save_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "object.dano"
    made = built(grid())
    made.save(path)
    before = path.read_bytes()

    def full_disk(file, **_):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space"):
        made.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


WRONG_TYPES = {
    'dano.Contact("ball", "floor", law="distributed")': (
        "law must be dano.DistributedLaw() or dano.CentroidLaw(), got 'distributed'"
    ),
    'dano.Contact("ball", "floor", 0.3)': (
        "params must be dano.ContactParams(…), e.g. sliding_friction=0.3, got 0.3"
    ),
    'dano.Contact(0, "floor")': "a must be the name of a body, got 0",
    'dano.Scene.create([ball], [("ball", "floor")])': (
        "contacts must hold dano.Contact objects only, got ('ball', 'floor') of type tuple"
    ),
    'dano.Scene.create(["ball"])': "bodies must hold dano.Body objects only, got 'ball' of type str",
    "dano.NeuralObject.from_field(np.zeros((8, 8, 8)))": (
        "field must be a dano field, got ndarray; dano.GridField(values, origin, spacing) makes one"
    ),
    "dano.NeuralObject.from_field(sphere, key=0)": (
        "key must be one random key such as jax.random.key(0), got 0"
    ),
    "dano.NeuralObject.from_field(sphere, n_samples=300.0)": "n_samples must be a whole number, got 300.0",
    "dano.NeuralObject.from_field(sphere, resolution=16.5)": "resolution must be a whole number, got 16.5",
    "dano.simulate(falling, falling.initial_state(), 2.5)": "n_steps must be a whole number, got 2.5",
    "dano.simulate(falling, falling.initial_state(), 9, checkpoint_every=2.5)": (
        "checkpoint_every must be a whole number, got 2.5"
    ),
    "dano.simulate(falling, 1.0, 3)": "state must be a dano.State, got float",
    'dano.simulate("scene.toml", None, 3)': "scene must be a dano.Scene, got str",
    "dano.step(falling, np.zeros(3))": "state must be a dano.State, got ndarray",
    "dano.linearize(ball, falling.initial_state())": "scene must be a dano.Scene, got Body",
    "dano.contact_history(falling, [1])": "state must be a dano.State, got list",
}
"""What users write who have not read the signature, and what they are told."""

PROGRAM = """
import json, sys
import numpy as np
import dano
sphere = dano.Sphere(0.1)
ball = dano.Body("ball", sphere, mass=1.0)
falling = dano.Scene.create([ball])
said = []
for line in json.load(sys.stdin):
    try:
        exec(line)
        said.append("nothing")
    except Exception as error:
        said.append(f"{type(error).__name__}: {error}")
print(json.dumps(said))
"""


def test_wrong_types():
    # In a process of its own: the tests' hook would check the types before dano does.
    answer = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps(list(WRONG_TYPES)),
        capture_output=True,
        text=True,
        check=True,
    )
    for told, (line, message) in zip(json.loads(answer.stdout), WRONG_TYPES.items(), strict=True):
        assert told.startswith(f"ValueError: {message}"), line
