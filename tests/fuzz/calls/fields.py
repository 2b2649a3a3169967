"""Shapes, fields, objects."""

from collections.abc import Iterator

import numpy as np

import dano
from dano import fields, objects
from tests.fuzz import kinds
from tests.fuzz.calls.call import Call
from tests.fuzz.kinds import (
    array,
    Bad,
    CHOICE,
    COUNT,
    FUNCTION,
    instance,
    KEY,
    NON_NEGATIVE,
    NUMBER,
    OPTIONAL_NON_NEGATIVE,
    OPTIONAL_POSITIVE,
    POSITIVE,
)
from tests.fuzz.world import World


def _shapes(_: World) -> Iterator[Call]:
    edge = {"edge": OPTIONAL_NON_NEGATIVE}
    size = array(3, positive=True)
    yield Call("Sphere", dano.Sphere, {"radius": 0.1}, {"radius": POSITIVE, **edge})
    yield Call(
        "Box", dano.Box, {"half_extents": (1, 1, 1)}, {"half_extents": size, "rounding": NON_NEGATIVE, **edge}
    )
    for name, shape in (("Capsule", dano.Capsule), ("Cylinder", dano.Cylinder)):
        good = {"radius": 0.1, "half_length": 0.2}
        yield Call(name, shape, good, {"radius": POSITIVE, "half_length": POSITIVE, **edge})
    yield Call("Ellipsoid", dano.Ellipsoid, {"semi_axes": (1, 2, 3)}, {"semi_axes": size, **edge})
    normal = {**array(3), "zero": np.zeros(3)}
    yield Call("HalfSpace", dano.HalfSpace, {}, {"normal": normal, "offset": NUMBER, **edge})
    quaternion = {**array(4), "zero": np.zeros(4)}
    yield Call("Pose", dano.Pose, {}, {"position": array(3), "orientation": quaternion})


def _fields(w: World) -> Iterator[Call]:
    values = {
        "nan": np.full((4, 4, 4), np.nan),
        "flat": np.ones((4, 4)),
        "negative": -np.ones((4, 4, 4)),
        "empty": np.ones((0, 4, 4)),
        "one": np.ones((1, 1, 1)),
        "text": "text",
        "texts": np.full((4, 4, 4), "a"),
        "nothing": None,
        "thing": kinds.Thing(),
    }
    place = {"origin": array(3), "spacing": POSITIVE, "interpolation": CHOICE}
    grid = {"values": np.ones((4, 4, 4)), "origin": (0, 0, 0), "spacing": 0.1}
    yield Call("GridField", dano.GridField, grid, {"values": values, **place})
    yield Call(
        "GridField.interpolating",
        dano.GridField.interpolating,
        {"samples": np.ones((4, 4, 4)), "origin": (0, 0, 0), "spacing": 0.1},
        {"samples": values, **place},
        {"samples": "s"},
    )
    distances = {name: value for name, value in values.items() if name != "negative"}
    yield Call(
        "fields.SignedDistanceGrid",
        fields.SignedDistanceGrid,
        {"distances": _ball_distances(), "origin": (0, 0, 0), "spacing": 0.1},
        {"distances": distances, **place, "edge": OPTIONAL_NON_NEGATIVE},
    )
    bounds = {
        "reversed": [(1, 1, 1), (0, 0, 0)],
        "flat": (0, 1),
        "nan": np.full((2, 3), np.nan),
        "text": "all",
        "nothing": None,
    }
    yield Call(
        "CallableField",
        dano.CallableField,
        {
            "function": lambda x: (x * x).sum(axis=-1),
            "bounds": [(-1, -1, -1), (1, 1, 1)],
            "framework": "numpy",
        },
        {
            "function": {**FUNCTION, "nothing": None},
            "bounds": bounds,
            "framework": CHOICE,
            "step": OPTIONAL_POSITIVE,
        },
    )
    yield Call(
        "bake",
        dano.bake,
        {"field": dano.Sphere(0.1), "resolution": 8},
        {
            "field": instance(),
            "resolution": COUNT,
            "interpolation": CHOICE,
            "batch_size": COUNT,
            "key": KEY,
            "progress": FUNCTION,
        },
    )
    yield Call(
        "posed",
        dano.posed,
        {"field": dano.Sphere(0.1), "pose": dano.Pose()},
        {"field": instance(), "pose": instance()},
    )
    yield Call(
        "scaled",
        dano.scaled,
        {"field": dano.Sphere(0.1), "factor": 2.0},
        {"field": instance(), "factor": POSITIVE},
    )
    yield Call(
        "union",
        lambda fields, **rest: dano.union(*fields, **rest),
        {"fields": [dano.Sphere(0.1), dano.Box((1, 1, 1))]},
        {"fields": {"none": [], "numbers": [1, 2], "texts": ["a", "b"]}, "edge": OPTIONAL_NON_NEGATIVE},
    )
    pyramid = {"none": np.ones((4, 4, 4, 4)), "text": "text", "number": 3, "nothing": None}
    yield Call("objects.fill_hollows", objects.fill_hollows, {"grid": w.grid}, {"grid": pyramid})
    yield Call(
        "objects.field_size",
        objects.field_size,
        {"field": w.grid},
        {"field": instance(), "resolution": COUNT, "density_range": RANGE},
    )


RANGE: Bad = {
    "reversed": (2.0, 1.0),
    "negative": (-1.0, 2.0),
    "nan": (kinds.NAN, 1.0),
    "one": (1.0,),
    "number": 1.0,
    "text": "all",
    "texts": ("a", "b"),
}


def _ball_distances() -> np.ndarray:
    """Signed distances of a ball on a grid of 12³ nodes."""
    x = np.stack(np.meshgrid(*(np.arange(12) - 5.5,) * 3, indexing="ij"), axis=-1)
    return 0.1 * (np.linalg.norm(x, axis=-1) - 4.0)


def _objects(w: World) -> Iterator[Call]:
    yield Call(
        "NeuralObject.from_field",
        dano.NeuralObject.from_field,
        {"field": w.grid, "n_samples": 50, "resolution": 8, "mass": 0.3},
        {
            "field": instance(),
            "n_samples": {**COUNT, "huge": 10**12},
            "resolution": {**COUNT, "huge": 10**6},
            "density_range": RANGE,
            "mass_model": CHOICE,
            "mass_scale": POSITIVE,
            "mass": OPTIONAL_POSITIVE,
            "key": KEY,
            "progress": FUNCTION,
        },
    )
    yield Call(
        "MassProperties.from_field",
        dano.MassProperties.from_field,
        {"field": w.grid, "resolution": 8},
        {
            "field": instance(),
            "mass_scale": POSITIVE,
            "mass": OPTIONAL_POSITIVE,
            "resolution": COUNT,
            "key": KEY,
        },
    )
    inertia = {
        **array(3, 3),
        "of no body": np.diag([1.0, 1.0, 5.0]),
        "negative": -np.eye(3),
        "lopsided": np.triu(np.ones((3, 3))),
    }
    mass = {"mass": 1.0, "com": (0, 0, 0), "inertia": np.eye(3)}
    bad_mass = {"mass": POSITIVE, "com": array(3), "inertia": inertia}
    yield Call("MassProperties", dano.MassProperties, mass, bad_mass)
    points = np.random.default_rng(0).normal(size=(9, 3))
    yield Call(
        "NeuralObject.from_samples",
        dano.NeuralObject.from_samples,
        {"points": points, "density": np.ones(9), **mass},
        {
            "points": array(9, 3),
            "density": {**array(9), "negative": -np.ones(9)},
            "normals": array(9, 3, optional=True),
            **bad_mass,
        },
    )
    cloud = {"points": np.ones((9, 3)), "density": np.ones(9), "normals": np.ones((9, 3))}
    yield Call(
        "ContactSamples",
        dano.ContactSamples,
        cloud,
        {"points": array(9, 3), "density": array(9), "normals": array(9, 3)},
    )
    surface = {"points": np.ones((9, 3)), "normals": np.ones((9, 3)), "areas": np.ones(9)}
    yield Call(
        "SurfaceSamples",
        dano.SurfaceSamples,
        surface,
        {
            "points": array(9, 3),
            "normals": array(9, 3),
            "areas": array(9),
            "vectors": array(9, 3, optional=True),
        },
    )
    draw = {"shape": dano.Sphere(0.1), "n": 20}
    yield Call(
        "objects.draw_surface",
        objects.draw_surface,
        draw,
        {"shape": instance(), "n": COUNT, "key": KEY, "skin": OPTIONAL_POSITIVE},
    )
    yield Call(
        "objects.draw_contact_samples",
        objects.draw_contact_samples,
        draw,
        {"shape": instance(), "n": COUNT, "key": KEY},
    )


PARTS = (_shapes, _fields, _objects)
