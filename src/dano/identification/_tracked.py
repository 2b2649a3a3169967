"""What poses with covariances, such as a tracker's, say of a window, and what they are off by alike."""

from collections.abc import Iterator, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dano.identification.motions import Motion
from dano.maths import quat_to_matrix
from dano.scene import Scene

_TOLD = 3.0
"""Factor of the standard deviations with which velocities from a tracker's poses count besides the poses: the
same data once more, as a ninth (convention)."""


def told_of(
    scene: Scene, motion: Motion, smooth, first: int, smoothing: int
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What poses tell of velocities and spins at a frame, and by how much that may be off."""
    rows, told = [scene.index(name) for name in motion.names], {}
    for key, width in motion.velocity_deviations(first, smoothing).items():
        whole = np.full((len(scene.bodies), 1), np.nan)
        if motion.alike is None:
            told[key] = smooth[key][first], whole
            continue
        share = motion.alike[2] * np.linalg.norm(smooth[key][first, rows], axis=-1)
        whole[rows, 0] = _TOLD * np.hypot(width, share if key == "velocity" else 0.0)
        told[key] = smooth[key][first], whole
    return told


def add_told(
    key: str,
    told: Sequence[tuple[np.ndarray, np.ndarray]],
    seen: Sequence[int],
    observed: dict[str, Array],
    weights: dict[str, Array],
) -> None:
    """Let count what poses of a tracker tell of the velocities with which windows begin, but not much.

    Else a slide begins with a hop that ends before the next frame, of which its poses say nothing.
    """
    values, widths = (np.stack(part)[:, seen] for part in zip(*told, strict=True))
    known = np.isfinite(values).all(axis=-1) & np.isfinite(widths[..., 0])
    if known.any():
        shape = observed[key].shape[:3]
        weight = np.array(weights.get(key, np.zeros(shape)))
        value = np.array(observed[key])
        w, n = np.nonzero(known)
        weight[w, 0, np.array(seen)[n]] = 1 / widths[known, 0]
        value[w, 0, np.array(seen)[n]] = values[known]
        dtype = observed[key].dtype
        observed[key], weights[key] = jnp.asarray(value, dtype), jnp.asarray(weight, dtype)


def pose_deviations(weights: Mapping[str, Array]) -> np.ndarray:
    """Standard deviations by which residuals of poses are divided, shape (w, f, n, 6); 0 where none count."""
    sizes = np.zeros((*next(iter(weights.values())).shape, 6))
    for first, key in ((0, "position"), (3, "orientation")):
        if key in weights:
            weight = np.asarray(weights[key], np.float64)
            sizes[..., first : first + 3] = np.where(weight > 0, 1 / np.maximum(weight, 1e-300), 0)[..., None]
    return sizes


def whitening_of(pieces: list[dict], deviations: np.ndarray) -> np.ndarray | None:
    """See `Windows`."""
    if all(piece["covariance"] is None for piece in pieces):
        return None
    result = np.tile(np.eye(6), (*deviations.shape[:3], 1, 1))
    for w, f, n, on in _with_covariance(pieces, deviations):
        scale = deviations[w, f, n, on]
        scaled = pieces[w]["covariance"][f, n][np.ix_(on, on)] / np.outer(scale, scale)
        result[w, f, n][np.ix_(on, on)] = np.linalg.inv(np.linalg.cholesky(scaled))
    return result


def common_of(
    scene: Scene, pieces: list[dict], deviations: np.ndarray, whitening: np.ndarray | None
) -> np.ndarray | None:
    """What all poses of a body that was tracked may be off by alike, in whitened residuals: see `Windows`.

    An offset, turn and scale with normal priors that all frames share are integrated over: residuals with
    covariance 1 + A Aᵀ are whitened by 1 − U Uᵀ, where A says what these do to them. A scale about the camera
    is one about the middle of all places, and an offset.
    """
    if whitening is None or all(piece["alike"] is None for piece in pieces):
        return None
    moved = np.zeros((*deviations.shape, 7))
    for w, f, n, on in _with_covariance(pieces, deviations):
        body, piece = scene.bodies[n], pieces[w]
        if piece["alike"] is None:
            continue
        slope = np.zeros((6, 7))
        offset, turned, share = piece["alike"]
        slope[:, :6] = np.diag(np.repeat([offset * body.size, turned], 3))
        if piece["origins"][n] and len(on) == 6:
            # The body turns about its middle, not about a distant origin.
            arm = np.cross(np.eye(3), np.asarray(body.centre_of_mass))
            slope[:3, 3:6] = turned * quat_to_matrix(piece["orientation"][f, n]) @ arm
        if np.isfinite(piece["position"][:, n]).any():
            slope[:3, 6] = share * (piece["position"][f, n] - np.nanmean(piece["position"][:, n], axis=0))
        scaled = slope / np.maximum(deviations[w, f, n, :, None], 1e-300)
        moved[w, f, n, on] = (whitening[w, f, n] @ scaled)[on]
    windows, frames, bodies = deviations.shape[:3]
    stacked = moved.transpose(0, 2, 1, 3, 4).reshape(windows, bodies, 6 * frames, 7)
    left, size, _ = np.linalg.svd(stacked, full_matrices=False)
    columns = left * np.sqrt(1 - 1 / np.sqrt(1 + size**2))[..., None, :]
    return columns.reshape(windows, bodies, frames, 6, -1).transpose(0, 2, 1, 3, 4)


def _with_covariance(
    pieces: list[dict], deviations: np.ndarray
) -> Iterator[tuple[int, int, int, np.ndarray]]:
    """Window, frame and body of each pose with a covariance, and which of its six numbers count."""
    for w, piece in enumerate(pieces):
        if piece["covariance"] is not None:
            for f, n in np.argwhere(np.isfinite(piece["covariance"]).all(axis=(-2, -1))):
                on = np.flatnonzero(deviations[w, f, n] > 0)
                if len(on):
                    yield w, int(f), int(n), on
