"""Random motions with impacts, in families that share a scene: throws, tosses, pushes, a rattling pile.

Where a body ends, along a random direction across the floor, is a function of ten numbers: friction and
restitution of all contacts, the mass of a body, and six or seven of how the motion starts.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

import dano
from dano.fields import posed, union
from dano.scene_file import build_asset

Start = Callable[[dano.State, Float[Array, " n"]], dano.State]
Random = np.random.Generator
FRICTION, RESTITUTION, TIMESTEP = 0.3, 0.3, 5e-3
CONTACT = ("friction", "restitution", "mass")
FREE = ("vx", "vy", "vz", "wx", "wy", "wz", "height")


class Draw(NamedTuple):
    """A random motion.

    Attributes:
        state: As it starts, but for what the numbers say.
        direction: Along which the end counts, shape (3,).
        numbers: The ten, and what is one of each.
        scales: …
    """

    state: dano.State
    direction: np.ndarray
    numbers: np.ndarray
    scales: np.ndarray


class Family(NamedTuple):
    """Motions of one scene.

    Attributes:
        scene: The scene.
        ends: Name of the body whose end counts, and whose mass is a number.
        labels: Of the numbers that say how a motion starts.
        start: Puts them into a state.
        draw: A state, numbers of its start and what is one of each.
        n_steps: Of a motion.
        motions: How many motions are looked at.
    """

    scene: dano.Scene
    ends: str
    labels: tuple[str, ...]
    start: Start
    draw: Callable[[Random], tuple[dano.State, np.ndarray, np.ndarray]]
    n_steps: int
    motions: int

    def end(self, x: Array, state: dano.State, direction: Array) -> Float[Array, ""]:
        """Where the body is at the end, along a direction [m], by friction, restitution, mass and start.

        A law that does not read the restitution does not depend on it.
        """
        scene, i = self.scene, self.scene.index(self.ends)
        for pair in scene.pairs:
            changed = {"sliding_friction": x[0], "restitution": x[1]}
            # All contacts have one law.
            read = self.scene.contacts[0].law.reads
            scene = scene.replace_contact(*pair, **{name: v for name, v in changed.items() if name in read})
        body = scene.bodies[i]
        scene = scene.replace_body(self.ends, mass=x[2] * body.mass, inertia=x[2] * body.inertia)
        run = dano.simulate(scene, self.start(state, x[3:]), self.n_steps)
        return run.states.position[-1, i] @ direction

    def random(self, rng: Random) -> Draw:
        """One of the motions."""
        state, numbers, scales = self.draw(rng)
        angle = rng.uniform(0, 2 * np.pi)
        return Draw(
            state,
            np.array([np.cos(angle), np.sin(angle), 0.0]),
            np.concatenate([[FRICTION, RESTITUTION, 1.0], numbers]),
            np.concatenate([[FRICTION, RESTITUTION, 1.0], scales]),
        )


def mug() -> dano.AbstractShape:
    """A cylinder with a handle."""
    handle = posed(dano.Box((0.015, 0.005, 0.03)), dano.Pose((0.05, 0, 0)))
    return union(dano.Cylinder(0.04, 0.05), handle)


def families(law: dano.AbstractContactLaw) -> dict[str, Family]:
    """All of them."""
    return {
        "bunny thrown": _thrown(law, dano.Body("a", build_asset("bunny")), 0.12, 20),
        "soap thrown": _thrown(law, dano.Body("a", build_asset("soap")), 0.1, 15),
        "mug thrown": _thrown(law, dano.Body("a", mug(), mass=0.3), 0.12, 10),
        "cube tossed": _thrown(law, dano.Body("a", dano.Box((0.05, 0.05, 0.05)), mass=0.37), 0.15, 15),
        "box on box": _two_bodies(law, 10),
        "pile of five": _pile(law, 10),
        "arm hits": _arm(law, 10),
        "four legs land": _quadruped(law, 10),
    }


def _scene(law: dano.AbstractContactLaw, bodies: list[dano.Body], pairs: list[tuple[str, str]], **more: Any):
    restitution = RESTITUTION if "restitution" in law.reads else None
    params = dano.ContactParams(sliding_friction=FRICTION, restitution=restitution)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    contacts = [dano.Contact(a, b, params, law=law) for a, b in pairs]
    return dano.Scene.create([*bodies, floor], contacts, timestep=TIMESTEP, **more)


def _free(i: int) -> Start:
    """Velocity, spin and height of a body."""

    def start(state: dano.State, x: Array) -> dano.State:
        return dataclasses.replace(
            state,
            position=state.position.at[i, 2].set(x[6]),
            velocity=state.velocity.at[i].set(x[:3]),
            omega=state.omega.at[i].set(x[3:6]),
        )

    return start


def _flight(rng: Random, height: float) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Orientation of a throw, its numbers and what is one of each."""
    angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.2)
    velocity = np.array([speed * np.cos(angle), speed * np.sin(angle), rng.uniform(-0.5, 0.3)])
    spin = rng.normal(size=3)
    spin *= rng.uniform(2.0, 8.0) / np.linalg.norm(spin)
    turn = rng.normal(size=4)
    numbers = np.concatenate([velocity, spin, [height]])
    scales = np.concatenate(
        [np.full(3, np.linalg.norm(velocity)), np.full(3, np.linalg.norm(spin)), [height]]
    )
    return dict(orientation=turn / np.linalg.norm(turn)), numbers, scales


def _thrown(law: dano.AbstractContactLaw, body: dano.Body, height: float, count: int) -> Family:
    scene = _scene(law, [body], [("a", "floor")])

    def draw(rng: Random):
        pose, numbers, scales = _flight(rng, height)
        return scene.initial_state(a=pose), numbers, scales

    return Family(scene, "a", FREE, _free(0), draw, 80, count)


def _two_bodies(law: dano.AbstractContactLaw, count: int) -> Family:
    """A box that falls on another one."""
    bodies = [
        dano.Body("a", dano.Box((0.05, 0.04, 0.03)), mass=0.4),
        dano.Body("b", dano.Box((0.06, 0.06, 0.04)), mass=0.8),
    ]
    scene = _scene(law, bodies, [("a", "b"), ("a", "floor"), ("b", "floor")])

    def draw(rng: Random):
        pose, numbers, scales = _flight(rng, 0.2)
        numbers[:2] *= 0.3
        return scene.initial_state(a=pose, b=dict(position=(0, 0, 0.04))), numbers, scales

    return Family(scene, "a", FREE, _free(0), draw, 80, count)


def _pile(law: dano.AbstractContactLaw, count: int) -> Family:
    """Five bodies that rattle down on each other; one of them starts otherwise."""
    shapes: list[dano.AbstractField] = [
        dano.Box((0.05, 0.04, 0.03)),
        dano.Sphere(0.04),
        dano.Box((0.04, 0.04, 0.04)),
        dano.Ellipsoid((0.05, 0.04, 0.03)),
        dano.Box((0.06, 0.03, 0.03)),
    ]
    names = "abcde"
    bodies = [dano.Body(name, shape, mass=0.5) for name, shape in zip(names, shapes, strict=True)]
    pairs = [(m, n) for i, m in enumerate(names) for n in names[i + 1 :]] + [(n, "floor") for n in names]
    scene = _scene(law, bodies, pairs)

    def draw(rng: Random):
        _, numbers, scales = _flight(rng, 0.1)
        starts: dict[str, dict[str, Any]] = {}
        for k, name in enumerate(names):
            turn = rng.normal(size=4)
            place = (*rng.uniform(-0.03, 0.03, 2), 0.1 + 0.11 * k)
            starts[name] = dict(position=place, orientation=turn / np.linalg.norm(turn))
        return scene.initial_state(**starts), 0.5 * numbers + [0, 0, 0, 0, 0, 0, 0.05], scales

    return Family(scene, "a", FREE, _free(0), draw, 60, count)


def _arm(law: dano.AbstractContactLaw, count: int) -> Family:
    """An arm of two links that swings into a box on a floor."""
    bodies = [
        dano.Body("upper", dano.Capsule(0.03, 0.12), mass=1.0),
        dano.Body("lower", dano.Capsule(0.03, 0.12), mass=0.7),
        dano.Body("box", dano.Box((0.04, 0.05, 0.06)), mass=0.5),
    ]
    lying = (np.cos(np.pi / 4), 0, np.sin(np.pi / 4), 0)
    joints = [
        dano.Joint(
            None, "upper", axis=(1, 0, 0), anchor=(0, 0, -0.15), position=(0, 0, 0.06), orientation=lying
        ),
        dano.Joint("upper", "lower", axis=(1, 0, 0), anchor=(0, 0, -0.15), position=(0, 0, 0.3)),
    ]
    scene = _scene(law, bodies, [("lower", "box"), ("box", "floor")], joints=joints)

    def start(state: dano.State, x: Array) -> dano.State:
        assert state.q is not None and state.v is not None
        return dataclasses.replace(
            state,
            q=state.q.at[:2].set(x[:2]),
            v=state.v.at[:2].set(x[2:4]),
            position=state.position.at[2, :2].set(x[4:6]),
            velocity=state.velocity.at[2, 0].set(x[6]),
        )

    def draw(rng: Random):
        state = scene.initial_state(box=dict(position=(0.3, 0.25, 0.06)))
        numbers = np.concatenate(
            [
                rng.uniform(-0.2, 0.1, 2),
                rng.uniform(-6.0, -3.0, 1),
                rng.uniform(-2, 0, 1),
                [0.35, 0.2],
                [0.05],
            ]
        )
        return state, numbers, np.array([1.0, 1.0, 5.0, 5.0, 0.1, 0.1, 0.2])

    labels = ("q0", "q1", "v0", "v1", "x", "y", "vx")
    return Family(scene, "box", labels, start, draw, 60, count)


def _quadruped(law: dano.AbstractContactLaw, count: int) -> Family:
    """A trunk on four sprung legs that lands on a floor."""
    trunk = dano.Body("trunk", dano.Box((0.2, 0.12, 0.05)), mass=8.0)
    places = {"lf": (1, 1), "rf": (1, -1), "lh": (-1, 1), "rh": (-1, -1)}
    legs = [dano.Body(name, dano.Capsule(0.025, 0.1), mass=0.5) for name in places]
    joints = [
        dano.Joint(
            "trunk", name, axis=(0, 1, 0), anchor=(0, 0, 0.1), position=(0.17 * x, 0.1 * y, -0.05),
            stiffness=60.0, damping=1.0,
        )
        for name, (x, y) in places.items()
    ]  # fmt: skip
    scene = _scene(law, [trunk, *legs], [(name, "floor") for name in places], joints=joints)

    def draw(rng: Random):
        _, numbers, scales = _flight(rng, 0.4)
        numbers[3:6] *= 0.2
        return scene.initial_state(trunk=dict(position=(0, 0, 0.4))), numbers, scales

    return Family(scene, "trunk", FREE, _free(0), draw, 60, count)
