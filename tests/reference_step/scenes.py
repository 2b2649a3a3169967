"""Scenes that the tests of this folder share: few, because each is compiled."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from reference_step.rotations import matrix

import dano

H = 2e-3
UPRIGHT, TILTED = (1.0, 0.0, 0.0, 0.2), (1.0, 0.3, 0.2, 0.1)
LYING = (np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0)
"""Turned a bit about z; tilted; with z along −y."""
FLOOR = dano.Body("floor", dano.HalfSpace(), fixed=True)
TABLE = dano.Body("table", dano.Box((0.2, 0.2, 0.03)), fixed=True)


@functools.cache
def pair(name):
    """A body "a" on something fixed."""
    shape, other, law, params = PAIRS[name]
    body = dano.Body("a", lump()) if shape is lump else dano.Body("a", shape, mass=1.0)
    contact = dano.Contact("a", other.name, dano.ContactParams(**params), law)
    return dano.Scene.create([body, other], [contact], timestep=H)


@functools.cache
def lump():
    """A neural object of three bumps, bunny-like, of 12 cm; its samples are more than 16 blocks."""
    axis = np.linspace(-0.07, 0.07, 20)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    bumps = (((0.02, 0.0, 0.0), 0.02), ((-0.02, -0.01, -0.01), 0.017), ((-0.01, 0.03, 0.01), 0.012))
    density = sum(np.exp(-np.sum((x - middle) ** 2, axis=-1) / (2 * width**2)) for middle, width in bumps)
    field = dano.GridField(density, (-0.07,) * 3, axis[1] - axis[0])
    return dano.NeuralObject.from_field(
        field, n_samples=300, density_range=(0.3, 10.0), mass_scale=2000.0, key=jax.random.key(0)
    )


@functools.cache
def flight():
    """Two objects and a box without gravity."""
    bodies = [
        dano.Body("a", lump()),
        dano.Body("b", lump()),
        dano.Body("box", dano.Box((0.05, 0.04, 0.03)), mass=0.2),
    ]
    material = dano.ContactParams(restitution=0.2)
    return dano.Scene.create(bodies, others=material, timestep=H, gravity=(0, 0, 0))


@functools.cache
def pile():
    """Two boxes and a ball on a floor; all touch."""
    bodies = [
        dano.Body("upper", dano.Box((0.05, 0.04, 0.03)), mass=2.0),
        dano.Body("lower", dano.Box((0.05, 0.05, 0.04)), mass=1.0, com=(0.01, 0.0, -0.01)),
        dano.Body("ball", dano.Sphere(0.03), mass=0.3),
        FLOOR,
    ]
    material = dano.ContactParams(sliding_friction=0.3, restitution=0.3)
    return dano.Scene.create(bodies, others=material, timestep=H)


PAIRS: dict[str, Any] = {
    "box on table": (dano.Box((0.05, 0.04, 0.03)), TABLE, None, dict(restitution=0.5, sliding_friction=0.4)),
    "box on floor": (dano.Box((0.05, 0.04, 0.03)), FLOOR, None, dict(restitution=0.5, sliding_friction=0.4)),
    "ball on table": (dano.Sphere(0.05), TABLE, None, dict(restitution=0.5)),
    "ellipsoid on table": (dano.Ellipsoid((0.05, 0.04, 0.03)), TABLE, None, dict(restitution=0.5)),
    "cylinder on floor": (dano.Cylinder(0.05, 0.03), FLOOR, None, dict(restitution=0.3)),
    "box on cylinder": (
        dano.Box((0.05, 0.04, 0.03)),
        dano.Body("roll", dano.Cylinder(0.1, 0.08), fixed=True),
        None,
        # Soft: what begins deeper than δ is followed back, at the largest spins through several radians.
        dict(restitution=0.5, stiffness=5e10, impact_depth=5e-4),
    ),
    "capsule on floor": (
        dano.Capsule(0.04, 0.03),
        FLOOR,
        dano.DistributedLaw(compliant=True, implicitness=0.5),
        dict(restitution=0.6, friction_fading=0.5),
    ),
    "object on floor": (lump, FLOOR, None, dict(restitution=0.2, sliding_friction=0.3)),
}

A = dict(orientation=UPRIGHT, velocity=(0.3, 0.1, -0.02), omega=(1.0, 2.0, 3.0))
SPINS = (10.0, 200.0, 600.0, 1100.0, 2000.0)


@functools.cache
def states(name):
    """What a pair of `PAIRS` starts from, by name; `gap` is the height of its lowest point."""
    top = {"table": 0.03, "floor": 0.0, "roll": 0.08}[pair(name).bodies[1].name]
    lying = LYING if name in ("cylinder on floor", "capsule on floor") else UPRIGHT
    found = {
        "at rest": dict(velocity=(0, 0, 0), omega=(0, 0, 0)),
        "slow": dict(velocity=(3e-3, 1e-3, 0), omega=(0, 0, 0.1)),
        "sliding": dict(omega=(0.1, 0.2, 0.3)),
        "tilted": dict(orientation=TILTED),
        "hitting": dict(orientation=TILTED, gap=1e-3, velocity=(0.3, 0.1, -1.5)),
        "deep": dict(gap=-0.015),
        "rolling": dict(omega=(6.0, 0.3, -0.4)),
    }
    if name == "cylinder on floor":
        found["on its end"] = dict(orientation=UPRIGHT)
    if top == 0.03:
        found["at the edge"] = dict(x=0.21, gap=-0.006, velocity=(-0.3, 0.1, -0.01))
        found["inside"] = dict(orientation=TILTED, gap=-0.065)
    for spin in SPINS:
        found[f"spinning at {spin:.0f} rad/s"] = dict(omega=(0.01 * spin, 0.02 * spin, spin))
    return {key: placed(name, top, {**A, "orientation": lying, **change}) for key, change in found.items()}


def placed(name, top, given, gap=-2e-4, x=0.004):
    """The state with the body's lowest point at a height over what it meets."""
    scene = pair(name)
    body = scene.bodies[0]
    given = dict(given)
    gap, x = given.pop("gap", gap), given.pop("x", x)
    assert body.surface is not None
    points = np.asarray(body.scale)[:, None] * np.asarray(body.surface.points)[:3]
    q = np.array(given["orientation"])
    down = matrix(q / np.linalg.norm(q))[2] @ (points - np.asarray(body.com)[:, None])
    lowest = down.min() if body.surface.turning != "ball" else -support(body, q)
    return scene.initial_state(a=dict(given, position=(x, 0.003, top + gap - lowest)))


def support(body, q):
    """How far a ball or an ellipsoid reaches down from its middle [m]."""
    return np.linalg.norm(np.asarray(body.scale) * matrix(q / np.linalg.norm(q))[2])


def names(name):
    """The names of `states`, without making any."""
    some = ["at rest", "slow", "sliding", "tilted", "hitting", "deep", "rolling"]
    some += {"cylinder on floor": ["on its end"]}.get(name, [])
    some += ["at the edge"] if name.endswith("on table") else []
    # Of a box that deep forces are so large that the plain search of the reference finds no root.
    some += ["inside"] if name in ("ball on table", "ellipsoid on table") else []
    if name == "box on floor":
        # … nor, at its stiffness, of one that begins deep.
        return [what for what in some if what != "deep"]
    return [*some, *(f"spinning at {spin:.0f} rad/s" for spin in SPINS)]


@functools.cache
def piled():
    """The pile and a state of it: a box slides on another, a ball hits that one and the floor."""
    scene = pile()
    state = scene.initial_state(
        upper=dict(position=(0.01, 0.005, 0.1096), orientation=(1, 0, 0, 0.3), velocity=(0.1, 0, 0)),
        lower=dict(position=(0.01, 0, 0.0298), orientation=(1, 0, 0, 0)),
        ball=dict(position=(0.081, 0.0, 0.0299), velocity=(-1.4, 0.1, -0.2), omega=(1, 2, 3)),
    )
    return scene, state


@functools.cache
def met():
    """The flight and a state of it: all three bodies meet."""
    scene = flight()
    state = scene.initial_state(
        a=dict(position=(0.0, 0.0, 0.0), velocity=(0.3, 0, 0), omega=(1, 2, 3)),
        b=dict(position=(0.085, 0.01, 0.0), orientation=TILTED, velocity=(-0.5, 0.1, 0), omega=(0, 20, 3)),
        box=dict(
            position=(0.0, 0.0, 0.066), orientation=(1, 0.1, 0, 0), velocity=(0, 0, -0.4), omega=(300, 0, 9)
        ),
    )
    return scene, state


@functools.cache
def tree():
    """All kinds of joints and laws: a tree on a body that floats, another on a fixed one, a body alone."""
    position = dano.Motor("position", stiffness=200.0, damping=5.0, gear=-1.5, limits=(-3, 2))
    velocity = dano.Motor("velocity", damping=5.0, limits=(-1, 2))
    effort = dano.Motor(gear=2.0, limits=(-1, 2))
    joints = [
        ("base", "arm", "hinge", dict(limits=(-0.1, 0.3), damping=0.1, armature=0.05, motor=position)),
        ("arm", "rod", "slide", dict(friction=2.0, stiffness=30.0, rest=0.1)),
        ("arm", "copy", "hinge", dict(mimics="arm", ratio=-1.7, shift=0.2, friction=0.4, armature=0.01)),
        ("copy", "hand", "ball", dict(damping=0.1, friction=0.2, stiffness=3.0)),
        ("hand", "tip", "weld", {}),
        ("base", "cart", "planar", dict(friction=1.0, damping=0.2)),
        ("wall", "door", "hinge", dict(limits=(-np.inf, 0.2), motor=velocity)),
        ("door", "bolt", "slide", dict(limits=(-0.2, 0.2), motor=effort)),
    ]
    box = dano.Box((0.2, 0.1, 0.05))
    bodies = [
        dano.Body("alone", dano.Box((0.1, 0.05, 0.02)), mass=0.5),
        dano.Body("base", box, mass=2.0),
        dano.Body("wall", box, fixed=True),
    ]
    return on_joints(joints, bodies)


def on_joints(joints, bodies=(), **options):
    """Boxes of random sizes on joints at random places, given as (parent, name, kind, laws)."""
    rng, bodies, made = np.random.default_rng(5), list(bodies), []
    for parent, name, kind, laws in joints:
        box = dano.Box(tuple(rng.uniform(0.03, 0.2, 3)))
        bodies.append(dano.Body(name, box, mass=rng.uniform(0.3, 2), com=rng.uniform(-0.05, 0.05, 3)))
        where = {key: rng.uniform(-0.2, 0.2, 3) for key in ("anchor", "position")}
        turn = rng.normal(size=4)
        made.append(
            dano.Joint(parent, name, kind, axis=rng.normal(size=3), orientation=turn, **where, **laws)
        )
    touching = {} if {"contacts", "others"} & set(options) else {"contacts": ()}
    return dano.Scene.create(bodies, joints=made, timestep=H, **touching, **options)


def random_motion(scene, speed, spin, seed=7):
    """A state in which joints move at about a speed and free bodies turn at about a spin; and a control."""
    rng, n, k = np.random.default_rng(seed), len(scene.bodies), scene.layout.n_joints
    moves = np.array([[not body.fixed] for body in scene.bodies], float)
    turn = rng.normal(size=(n, 4))
    parts = (
        rng.uniform(-1, 1, (n, 3)),
        turn / np.linalg.norm(turn, axis=1, keepdims=True),
        moves * rng.normal(size=(n, 3)),
        spin * moves * rng.normal(size=(n, 3)) / np.sqrt(3),
        rng.uniform(-0.4, 0.4, k),
        speed * rng.normal(size=k),
    )
    pushes = (
        rng.normal(size=(n, 3)),
        0.1 * rng.normal(size=(n, 3)),
        rng.normal(size=k),
        3 * rng.normal(size=k),
    )
    control = dano.Control(*(jnp.asarray(x) for x in pushes))
    return scene.filled(dano.State(*(jnp.asarray(x) for x in parts))), control


@functools.cache
def linkage():
    """A crank, a coupler and a rocker that a loop closes, and a weld that closes a chain of two balls."""
    lengths = {"crank": 0.2, "coupler": 0.5, "rocker": 0.4}
    bodies = [dano.Body(name, dano.Box((x / 2, 0.01, 0.01)), mass=x) for name, x in lengths.items()]
    places = {"crank": (None, 0.1), "coupler": ("crank", 0.35), "rocker": (None, 0.65)}
    joints = [
        dano.Joint(on, name, axis=(0, 1, 0), anchor=(-lengths[name] / 2, 0, 0), position=(x, 0, 0))
        for name, (on, x) in places.items()
    ]
    loop = dano.Loop("coupler", "rocker", position=(0.25, 0, 0), anchor=(0.2, 0, 0))
    return dano.Scene.create(bodies, contacts=(), joints=joints, loops=[loop], timestep=H)


@functools.cache
def door():
    """A door on a hinge that pushes a ball, by the default law or by the paper's."""
    bodies = [
        dano.Body("door", dano.Box((0.4, 0.02, 0.5)), mass=8.0),
        dano.Body("ball", dano.Sphere(0.1), mass=2.0),
    ]
    hinge = dano.Joint(
        None, "door", axis=(0, 0, 1), anchor=(-0.4, 0, 0), position=(0.4, 0, 0.6), damping=0.5, friction=0.1
    )
    return tuple(
        dano.Scene.create(
            bodies, [dano.Contact("door", "ball", law=law)], joints=[hinge], timestep=H, gravity=(0, 0, 0)
        )
        for law in (dano.DistributedLaw(), dano.CentroidLaw(stiction_velocity=1e-7))
    )
