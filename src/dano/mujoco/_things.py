"""A neural object as the search for contacts wants it: arrays in the frame of its MuJoCo body."""

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dano.maths import checked_array, Numbers, quat_to_matrix
from dano.mujoco._faces import Faces, faces_of
from dano.mujoco._surfaces import Surface, surface_of
from dano.objects import NeuralObject
from dano.scene_file import load_object


@dataclass(frozen=True)
class Thing:
    """An object on a body."""

    obj: NeuralObject  # The object
    surface: Surface  # Its samples, in the body frame
    faces: Faces  # Its flat faces, in the body frame
    middle: Float[np.ndarray, "3"]  # Centre of a ball around all samples [m]
    radius: float  # Of that ball [m]
    size: float  # Largest extent [m]
    thickness: float  # How deep its deepest place lies below its surface [m]
    rotation: Float[np.ndarray, "3 3"]  # Field frame → body frame, shape (3, 3)
    origin: Float[np.ndarray, "3"]  # Of the field frame, in the body frame [m]
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # Centre of mass [m, body frame]
    inertia: Float[np.ndarray, "3 3"]  # About it, in the axes of the body frame [kg m²]
    bits: tuple[int, int]  # contype and conaffinity, as of MuJoCo's geoms


def checked_thing(
    obj: NeuralObject | str | os.PathLike[str],
    position: Numbers,
    orientation: Numbers,
    bits: tuple[int, int],
) -> Thing:
    """What `thing_of` makes of the arguments of an `attach`.

    Raises:
        ValueError: If they are no object or no pose.
    """
    if isinstance(obj, str | os.PathLike):
        obj = load_object(obj)
    if not isinstance(obj, NeuralObject):
        raise ValueError(f"obj must be a NeuralObject or the path of one, got {type(obj).__name__}")
    place = np.asarray(checked_array("position", position, (3,)), np.float64)
    turn = np.asarray(checked_array("orientation", orientation, (4,)), np.float64)
    if not np.linalg.norm(turn) > 0:
        raise ValueError(f"orientation must not be zero, got {turn.tolist()}")
    return thing_of(obj, place, turn / np.linalg.norm(turn), bits)


def thing_of(
    obj: NeuralObject,
    position: Float[np.ndarray, "3"],
    orientation: Float[np.ndarray, "4"],
    bits: tuple[int, int],
) -> Thing:
    """An object whose field frame has a pose in the frame of its body; `bits`: see `Thing`."""
    rotation = np.asarray(quat_to_matrix(orientation), np.float64)
    surface = surface_of(obj.surface.points, obj.surface.vectors).moved(rotation, position)
    lower, upper = surface.points.min(axis=0), surface.points.max(axis=0)
    middle = 0.5 * (lower + upper)
    # Without a solid its extent is all that is known.
    thickness = 0.5 * float((upper - lower).min())
    if obj.solid is not None:
        thickness = min(thickness, -float(np.min(np.asarray(obj.solid.distances))))
    return Thing(
        obj=obj,
        surface=surface,
        faces=faces_of(obj).moved(rotation, position),
        middle=middle,
        radius=float(np.linalg.norm(surface.points - middle, axis=1).max()),
        size=float((upper - lower).max()),
        thickness=thickness,
        rotation=rotation,
        origin=np.asarray(position, np.float64),
        mass=float(obj.mass.mass),
        com=rotation @ np.asarray(obj.mass.com, np.float64) + position,
        inertia=rotation @ np.asarray(obj.mass.inertia, np.float64) @ rotation.T,
        bits=bits,
    )
