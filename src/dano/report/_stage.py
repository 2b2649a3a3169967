"""Scenes as pictures see them: drawable items, their poses, a camera that keeps all in view, forces."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from dano.checks import checked_kind
from dano.engine import contact_history
from dano.maths import Pose, quat_to_matrix
from dano.scene import Body, Scene, Trajectory
from dano.vision import Item, LearnedField, PALETTE

_MOST_SHARE = 2.5
"""Longest arrow of a force, in those of the usual one (chosen by eye)."""


def check_run(scene: Scene, trajectory: Trajectory, name: str = "trajectory") -> None:
    """Check that a trajectory is one of a scene, with at least one step, and finite.

    Args:
        scene: The scene.
        trajectory: What may have happened in it.
        name: Of the argument, for errors.

    Raises:
        ValueError: If it is not.
    """
    checked_kind("scene", scene, Scene)
    checked_kind(name, trajectory, Trajectory)
    if tuple(trajectory.names) != tuple(scene.names):
        raise ValueError(
            f"{name} must be of this scene with bodies {list(scene.names)}, got {list(trajectory.names)}"
        )
    if len(trajectory.times) < 2:
        raise ValueError(f"{name} must have at least one step, got {len(trajectory.times)} states")
    if not np.all(np.isfinite(np.asarray(trajectory.states.position))):
        raise ValueError(f"{name} must be finite, got positions that are NaN or infinite")


class Stage(NamedTuple):
    """What of a scene is drawn."""

    items: list[Item]  # One per drawable body, at the identity
    rows: list[int]  # Index of the body of each item
    offsets: list[np.ndarray]  # Centre of mass in the field frame [m, F] of each item

    def posed(
        self, position: Float[np.ndarray, "bodies 3"], orientation: Float[np.ndarray, "bodies 4"]
    ) -> list[Item]:
        """The items where the bodies are."""
        placed = []
        for item, row, com in zip(self.items, self.rows, self.offsets, strict=True):
            rotation = quat_to_matrix(orientation[row])
            pose = eqx.tree_at(
                lambda p: (p.position, p.orientation),
                item.pose,
                (position[row] - rotation @ com, orientation[row]),
            )
            placed.append(item.at(pose))
        return placed


def stage(
    scene: Scene, colours: Mapping[str, str] | None = None, looks: Mapping[str, LearnedField] | None = None
) -> Stage:
    """Make the bodies of a scene ready for drawing; bodies without a field or shape are left out.

    Raises:
        ValueError: If a colour is not "#rrggbb", a colour or look names no body, or nothing can be drawn.
    """
    colours = checked_kind("colours", {} if colours is None else colours, Mapping)
    looks = checked_kind("looks", {} if looks is None else looks, Mapping)
    for name in (*colours, *looks):
        scene.index(name)
    for name, look in looks.items():
        checked_kind(f"looks of {name!r}", look, LearnedField)
    items, rows, offsets, used = [], [], [], 0
    for row, body in enumerate(scene.bodies):
        if body.field is None:
            continue
        plane = body.shape is not None and not np.isfinite(body.size)
        colour = colours.get(body.name, None if plane else PALETTE[used % len(PALETTE)])
        if body.name in looks and body.name not in colours:
            items.append(Item(looks[body.name]))
        else:
            items.append(Item(body.field, Pose(), colour, level=level_of(body)))
        rows.append(row)
        offsets.append(np.asarray(body.centre_of_mass, np.float64))
        used += not plane
    if not items:
        raise ValueError(
            f"scene must hold a body with a field or a shape, got {list(scene.names)} without any"
        )
    return Stage(items, rows, offsets)


def level_of(body: Body) -> float | None:
    """Density at which the surface of a neural object is drawn; None for a shape."""
    return (
        None if body.object is None else object_level(np.asarray(body.object.density_range, dtype=np.float64))
    )


def object_level(density_range: np.ndarray) -> float:
    """Where in a range of densities the eye sees the surface: low in it, for that is where contact begins."""
    low, high = float(density_range[0]), float(density_range[1])
    return low**0.75 * high**0.25 if low > 0 else 0.1 * high


class Touches(NamedTuple):
    """Contact forces at the times of frames."""

    points: Float[np.ndarray, "frames contacts 3"]  # Centroids of the overlaps [m, W], (frames, contacts, 3)
    # On the first body of each contact [N, W], (frames, contacts, 3).
    forces: Float[np.ndarray, "frames contacts 3"]
    # Force over the usual one, (frames, contacts); zero where nothing touches.
    shares: Float[np.ndarray, "frames contacts"]
    usual: float  # Usual force [N], for arrows; zero if nothing touches at all

    def beside(self, usual: float) -> "Touches":
        """The same with another usual force, so that arrows can be compared with those of other runs."""
        shares = np.clip(np.linalg.norm(self.forces, axis=-1) / usual, 0, _MOST_SHARE)
        return self._replace(shares=np.where(self.shares > 0, shares, 0.0), usual=usual)


def touches(scene: Scene, trajectory: Trajectory, times: Float[np.ndarray, " frames"]) -> Touches | None:
    """Contact points and forces of the steps that the times fall into; None without contacts in the scene."""
    if not scene.pairs:
        return None
    history = contact_history(scene, trajectory.states)
    known = np.asarray(trajectory.times, dtype=np.float64)
    step = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    points, overlap, forces = (array[step] for array in history)
    size = np.linalg.norm(forces, axis=-1)
    # A landing is a hundred times the weight; what matters to the eye is the usual force, so the rest is
    # clipped.
    usual = float(np.quantile(size[size > 1e-9], 0.8)) if np.any(size > 1e-9) else 0.0
    shares = np.clip(size / (usual or 1.0), 0, _MOST_SHARE)
    shares = np.where((overlap > 0) & np.isfinite(points).all(axis=-1), shares, 0.0)
    return Touches(points, forces, shares, usual)
