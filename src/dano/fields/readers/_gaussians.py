"""Gaussian splats as they are: selected, moved, and written for programs that draw them."""

import dataclasses
import math
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from dano.checks import checked_path
from dano.maths import Numbers, Pose, quat_multiply, quat_to_matrix

Y0 = 0.5 / math.sqrt(math.pi)
"""The harmonic of degree 0: a colour of sRGB is ½ + Y0 times its coefficient (Kerbl et al. 2023)."""


@dataclasses.dataclass(frozen=True)
class Splats:
    """Gaussians that a scene is drawn with, as NumPy arrays in one frame.

    Attributes:
        means: Centres [m], shape (n, 3).
        scales: Logarithms of the standard deviations [m] along the axes of each, shape (n, 3).
        quats: Orientations wxyz, not necessarily of unit length, shape (n, 4).
        opacities: Logits of the opacities, shape (n,).
        colours: Coefficients of spherical harmonics of degrees 0 to 3, shape (n, k, 3) with k = 1, 4, 9 or
            16.
    """

    means: Float[np.ndarray, "n 3"]
    scales: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]
    opacities: Float[np.ndarray, " n"]
    colours: Float[np.ndarray, "n k 3"]

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.colours.shape[1]) - 1

    @property
    def alphas(self) -> Float[np.ndarray, " n"]:
        """Opacities in [0, 1]."""
        return 1 / (1 + np.exp(-np.clip(self.opacities, -80, 80)))

    @property
    def rotations(self) -> Float[np.ndarray, "n 4"]:
        """Unit quaternions wxyz."""
        return self.quats / np.linalg.norm(self.quats, axis=1, keepdims=True)

    def inside(self, box: Numbers | None = None, sphere: Numbers | None = None) -> Bool[np.ndarray, " n"]:
        """Which Gaussians have their centre in a box, or in a sphere, or in both.

        Args:
            box: Lowest x, y, z and highest x, y, z [m], shape (2, 3) or (6,).
            sphere: Centre x, y, z and radius [m], shape (4,).

        Raises:
            ValueError: If a corner is not above the other one, the radius is not positive, or no Gaussian is
                inside.
        """
        found = np.ones(len(self), bool)
        if box is not None:
            low, high = checked_corners(box)
            found &= np.all((self.means >= low) & (self.means <= high), axis=1)
        if sphere is not None:
            *centre, radius = checked_sphere(sphere)
            found &= np.linalg.norm(self.means - centre, axis=1) <= radius
        if not found.any():
            low, high = np.min(self.means, axis=0), np.max(self.means, axis=0)
            raise ValueError(
                f"no centre of the {len(self)} Gaussians lies in box {box}, sphere {sphere}; theirs are from"
                f" {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()}"
            )
        return found

    def chosen(self, rows: Bool[np.ndarray, " n"]) -> "Splats":
        """Those of some rows."""
        return Splats(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def moved(self, pose: Pose | None = None, scale: float = 1.0) -> "Splats":
        """The same scaled about the origin, then turned and moved; colours turn with them.

        Args:
            pose: Where to.
            scale: Length [m] of a unit.
        """
        made = dataclasses.replace(self, means=self.means * scale, scales=self.scales + math.log(scale))
        if pose is None:
            return made
        turn = np.asarray(pose.orientation, np.float64)
        matrix = quat_to_matrix(turn)
        return dataclasses.replace(
            made,
            means=made.means @ matrix.T + np.asarray(pose.position, np.float64),
            quats=np.asarray(quat_multiply(turn[None], self.rotations)),
            colours=np.einsum("jk,nkc->njc", _turned_harmonics(matrix, self.degree), self.colours),
        )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Arguments of `mujoco_warp.create_render_context`, whose splats have one colour from all sides."""
        rgb = np.clip(0.5 + Y0 * self.colours[:, 0], 0, 1)
        found = {
            "splat_position": self.means,
            "splat_rotation": self.rotations,
            "splat_scale": np.exp(self.scales),
            "splat_rgba": np.concatenate([rgb, self.alphas[:, None]], axis=1),
        }
        return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}

    def save(self, path: str | Path) -> None:
        """Write a binary .ply as those of Kerbl et al., which all programs for splats read.

        Raises:
            ValueError: If `path` does not end in .ply or lies in no folder.
        """
        path = checked_path("path", path)
        if path.suffix.lower() != ".ply":
            raise ValueError(f"path must end in .ply, got {path}")
        # Kerbl et al. list the higher coefficients channel by channel.
        rest = self.colours[:, 1:].transpose(0, 2, 1).reshape(len(self), -1)
        columns = {
            **{axis: self.means[:, i] for i, axis in enumerate("xyz")},
            **{f"n{axis}": np.zeros(len(self)) for axis in "xyz"},
            **{f"f_dc_{i}": self.colours[:, 0, i] for i in range(3)},
            **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
            "opacity": self.opacities,
            **{f"scale_{i}": self.scales[:, i] for i in range(3)},
            **{f"rot_{i}": self.quats[:, i] for i in range(4)},
        }
        properties = "".join(f"property float {name}\n" for name in columns)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(self)}\n{properties}end_header\n"
        table = np.stack(list(columns.values()), axis=1).astype("<f4")
        path.write_bytes(head.encode("ascii") + table.tobytes())


def checked_corners(box: Numbers) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner.

    Raises:
        ValueError: If they are not six finite numbers, or one is not above the other.
    """
    corners = np.asarray(box, np.float64)
    if corners.size != 6 or not np.all(np.isfinite(corners)):
        raise ValueError(f"box must be lowest x y z and highest x y z, got {box}")
    corners = corners.reshape(2, 3)
    if not np.all(corners[1] > corners[0]):
        raise ValueError(f"box must have its second corner above its first on all axes, got {box}")
    return corners


def checked_sphere(sphere: Numbers) -> Float[np.ndarray, "4"]:
    """Centre and radius.

    Raises:
        ValueError: If they are not four finite numbers, or the radius is not positive.
    """
    numbers = np.asarray(sphere, np.float64)
    if numbers.shape != (4,) or not np.all(np.isfinite(numbers)) or numbers[3] <= 0:
        raise ValueError(f"sphere must be centre x y z and a radius > 0, got {sphere}")
    return numbers


def harmonics(directions: Float[np.ndarray, "n 3"], degree: int) -> Float[np.ndarray, "n k"]:
    """Real spherical harmonics up to a degree, in the order and with the signs of Kerbl et al. (2023).

    Args:
        directions: Unit vectors.
        degree: 0 to 3.
    """
    x, y, z = directions.T
    pi = math.pi
    one, two = math.sqrt(3 / (4 * pi)), 0.5 * math.sqrt(15 / pi)
    found = [np.full_like(x, Y0), -one * y, one * z, -one * x]
    found += [two * x * y, -two * y * z, 0.25 * math.sqrt(5 / pi) * (3 * z**2 - 1), -two * x * z]
    found += [0.5 * two * (x**2 - y**2)]
    outer, middle = 0.25 * math.sqrt(35 / (2 * pi)), 0.25 * math.sqrt(21 / (2 * pi))
    cross = 0.5 * math.sqrt(105 / pi)
    found += [-outer * y * (3 * x**2 - y**2), cross * x * y * z, -middle * y * (5 * z**2 - 1)]
    found += [0.25 * math.sqrt(7 / pi) * z * (5 * z**2 - 3), -middle * x * (5 * z**2 - 1)]
    found += [0.5 * cross * z * (x**2 - y**2), -outer * x * (x**2 - 3 * y**2)]
    return np.stack(found[: (degree + 1) ** 2], axis=1)


def _turned_harmonics(matrix: Float[np.ndarray, "3 3"], degree: int) -> Float[np.ndarray, "k k"]:
    """Coefficients of what is turned, from those before: c'(d) = c(Rᵀ d), by least squares."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = harmonics(directions @ matrix, degree)
    return np.linalg.lstsq(harmonics(directions, degree), before, rcond=None)[0]
