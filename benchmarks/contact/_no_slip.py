"""Rigid bodies that roll on a plane without slipping or leaving it, integrated to high order.

For a body with contact point p (from the centre of mass, in body axes), angular velocity ω and the direction
u straight down, no slip means v = p × ω for the velocity of the centre of mass. Newton's and Euler's
equations without the force of contact are then, for mass m, inertia J and gravity g u,

    (J + m (|p|² − p pᵀ)) ω̇ = −ω × J ω + m p × (ṗ × ω + ω × (p × ω)) − m g p × u,     u̇ = −ω × u

(P. Appell, Traité de mécanique rationnelle II; A. Garcia and M. Hubbard, "Spin reversal of the rattleback:
theory and experiment", Proc. R. Soc. Lond. A 418, 165 (1988), have them for the ellipsoid).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

GRAVITY = 9.81

Contact = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From u and u̇ to the contact point p [m] and ṗ [m/s]."""


@dataclass(frozen=True)
class Roller:
    """A rigid body on a plane.

    Attributes:
        mass: [kg].
        inertia: About the centre of mass [kg m², B].
        contact: Its lowest point.
    """

    mass: float
    inertia: np.ndarray
    contact: Contact

    def start(self, rotation: np.ndarray, omega: np.ndarray) -> dict[str, np.ndarray]:
        """Initial state for `Scene.initial_state`: on the plane, over the origin, without slip.

        Args:
            rotation: B → W, shape (3, 3).
            omega: [rad/s, B].
        """
        p, _ = self.contact(-rotation[2], np.zeros(3))
        return {
            "position": np.array([0.0, 0.0, -(rotation @ p)[2]]),
            "orientation": Rotation.from_matrix(rotation).as_quat(scalar_first=True),
            "velocity": rotation @ np.cross(p, omega),
            "omega": omega,
        }

    def roll(
        self, rotation: np.ndarray, omega: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [m, W] (t, 3), rotations (t, 3, 3) and angular velocities [rad/s, B] (t, 3)."""
        y0 = np.concatenate([rotation.ravel(), omega, np.zeros(2)])
        solved = solve_ivp(
            self._slopes, (times[0], times[-1]), y0, method="DOP853", t_eval=times, rtol=1e-9, atol=1e-10
        )
        rotations = solved.y[:9].T.reshape(-1, 3, 3)
        heights = [-(R @ self.contact(-R[2], np.zeros(3))[0])[2] for R in rotations]
        return np.column_stack([solved.y[12:].T, heights]), rotations, solved.y[9:12].T

    def _slopes(self, _: float, y: np.ndarray) -> np.ndarray:
        R, w = y[:9].reshape(3, 3), y[9:12]
        u = -R[2]
        p, dp = self.contact(u, -np.cross(w, u))
        torque = -np.cross(w, self.inertia @ w)
        torque += self.mass * np.cross(p, np.cross(dp, w) + np.cross(w, np.cross(p, w)) - GRAVITY * u)
        about_contact = self.inertia + self.mass * (p @ p * np.eye(3) - np.outer(p, p))
        turning = R @ _cross_matrix(w)
        return np.concatenate(
            [turning.ravel(), np.linalg.solve(about_contact, torque), (R @ np.cross(p, w))[:2]]
        )


def ball_contact(radius: float, centre: np.ndarray) -> Contact:
    """Of a sphere whose centre lies there from the centre of mass [m, B]."""
    return lambda u, du: (radius * u + centre, radius * du)


def ellipsoid_contact(semi_axes: tuple[float, float, float]) -> Contact:
    """Of an ellipsoid with its centre of mass in the middle."""
    squares = np.square(semi_axes)

    def contact(u: np.ndarray, du: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = np.sqrt(u @ (squares * u))
        return squares * u / s, squares * du / s - squares * u * (u @ (squares * du)) / s**3

    return contact


def rim_contact(radius: float, half_length: float) -> Contact:
    """Of a cylinder along z that stands on the rim of its lower end."""

    def contact(u: np.ndarray, du: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        across = u * (1, 1, 0)
        length = np.linalg.norm(across)
        point = radius * across / length + np.array([0, 0, np.sign(u[2]) * half_length])
        change = du * (1, 1, 0)
        return point, radius * (change / length - across * (across @ change) / length**3)

    return contact


def _cross_matrix(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
