"""Small corrections of stated cameras, learned with the field.

Photographs come with poses and lenses that are off by a pixel or so, which blurs what is learned from them.
What cannot be told from photographs, a motion or an enlargement of cameras and object together, is left out.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.maths import einsum, quat_exp, quat_to_matrix
from dano.vision.capture import Rays, View


class Adjustment(eqx.Module):
    """Corrections of the cameras of some views, to first order."""

    # Turns about, then shifts along each camera's axes (right, up, forward), in units in which one turn or
    # shift across the line of sight moves the picture of the object by a pixel.
    correction: Float[Array, "views 6"]
    axes: Float[Array, "views 3 3"]  # The cameras' axes [W], one a row, shape (views, 3, 3)
    angle: Float[Array, " views"]  # Angles of a pixel [rad], shape (views,)
    length: Float[Array, " views"]  # What these are at the object [m], shape (views,)
    # Orthonormal columns: corrections that are a motion or an enlargement of everything.
    free: Float[Array, "corrections 7"]

    @classmethod
    def create(cls, views: Sequence[View], middle: Float[np.ndarray, "3"]) -> "Adjustment":
        """None yet, for views of an object around a point [m, W]."""
        axes = np.stack([view.camera.axes for view in views])
        away = np.stack([view.camera.position for view in views]) - middle
        angle = np.array([view.camera.pixel_angle for view in views])
        length = angle * np.linalg.norm(away, axis=1)
        motions = []
        for axis in np.eye(3):
            turn = np.concatenate(
                [axes @ axis / angle[:, None], _along(axes, np.cross(axis, away), length)], 1
            )
            shift = np.concatenate([0 * away, _along(axes, np.broadcast_to(axis, away.shape), length)], 1)
            motions += [turn, shift]
        motions.append(np.concatenate([0 * away, _along(axes, away, length)], 1))
        columns = np.stack([motion.ravel() for motion in motions], axis=1)
        free = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
        numbers = np.zeros((len(views), 6)), axes, angle, length, free
        return cls(*(jnp.asarray(x, jnp.float32) for x in numbers))

    @property
    def corrections(self) -> Float[Array, "views 6"]:
        """Without what cannot be told."""
        flat = self.correction.ravel()
        return (flat - self.free @ (self.free.T @ flat)).reshape(self.correction.shape)

    def moved(self, rays: Rays, view: Int[Array, " rays"]) -> Rays:
        """Rays of the stated cameras as those of the corrected ones.

        Args:
            rays: Some rays.
            view: Which view each belongs to.
        """
        corrections = self.corrections
        turn = einsum("vij,vi->vj", self.axes, corrections[:, :3] * self.angle[:, None])
        shift = einsum("vij,vi->vj", self.axes, corrections[:, 3:] * self.length[:, None])
        direction = rays.direction + jnp.cross(turn[view], rays.direction)
        direction = direction * jax.lax.rsqrt(jnp.sum(direction**2, axis=1, keepdims=True))
        return rays._replace(origin=rays.origin + shift[view], direction=direction)

    def corrected(self, views: Sequence[View]) -> tuple[View, ...]:
        """The views that corrections are of, with corrected cameras."""
        return tuple(
            _turned(view, row, float(angle), float(length))
            for view, row, angle, length in zip(
                views, np.asarray(self.corrections, np.float64), self.angle, self.length, strict=True
            )
        )

    def corrected_lens(self, views: Sequence[View]) -> tuple[View, ...]:
        """Other views, corrected by the turn that all cameras have in common: a matter of the lens."""
        common = np.zeros(6)
        common[:3] = np.asarray(self.corrections, np.float64)[:, :3].mean(0)
        return tuple(_turned(view, common, view.camera.pixel_angle, 0.0) for view in views)


def _along(axes: np.ndarray, vectors: np.ndarray, length: np.ndarray) -> np.ndarray:
    return np.einsum("vij,vj->vi", axes, vectors) / length[:, None]


def _turned(view: View, correction: np.ndarray, angle: float, length: float) -> View:
    camera = view.camera
    turn = quat_to_matrix(quat_exp(camera.axes.T @ correction[:3] * angle))
    pose = camera.pose.copy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] += camera.axes.T @ correction[3:] * length
    return view.replaced(camera=camera.replaced(camera_to_world=pose))
