"""The numbers of a scene and a state as NumPy arrays; spins in world axes."""

from typing import NamedTuple

import numpy as np
from reference_step.rotations import gyroscopic_gain, matrix, multiply, turn


class Bodies(NamedTuple):
    """All n bodies of a scene at the start of a step of length h [s] with gravity [m/s²].

    Attributes:
        moves: Whether each body moves, shape (n,).
        mass: [kg], shape (n,).
        inertia: About the centre of mass [kg m², B], shape (n, 3, 3).
        com: Centre of mass [m, F], shape (n, 3).
        position: Of the centres of mass [m, W], shape (n, 3).
        orientation: wxyz, shape (n, 4).
        ahead: Orientations at the end of the step at the old spins.
        ahead_falling: The same with what the spins gain.
        velocity: [m/s, W], zero for a fixed body.
        spin: [rad/s, W], the same.
        gain: What gravity adds to the velocity of a body that falls freely [m/s, W], shape (n, 3).
        spin_gain: What gyroscopic torques add to its spin [rad/s, W], shape (n, 3).
        falls: `gain` without what supports a body.
        inverse_mass: 1/m, zero for a fixed body [1/kg].
        inverse_inertia: [1/(kg m²), W], the same.
    """

    h: float
    gravity: np.ndarray
    moves: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    com: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    ahead: np.ndarray
    ahead_falling: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    gain: np.ndarray
    spin_gain: np.ndarray
    falls: np.ndarray
    inverse_mass: np.ndarray
    inverse_inertia: np.ndarray

    def pose(self, i, share):
        """Position [m, W] and rotation of a body after a share of the step at the old velocities.

        Centres of mass move on lines, or parabolas where they fall, with a velocity that is that of half a
        step before; quaternions move on the chord between start and end, normalised.
        """
        q = self.orientation[i] + share * (self.ahead[i] - self.orientation[i])
        # Spins are those of half a step before, too: the turn is less than that share of the whole one.
        lag = -0.25 * share * (1 - share) * self.h * self.spin_gain[i]
        q = multiply(np.r_[1, lag] / np.sqrt(1 + lag @ lag), q)
        start = self.velocity[i] + 0.5 * self.gain[i]
        way = share * self.h * (start + 0.5 * share * self.gain[i])
        return self.position[i] + way, matrix(q / np.linalg.norm(q))

    def gains(self, i, j):
        """What `relative` gains within the step."""
        away = self.position[i] - self.position[j]
        gain = self.gain[i] - self.gain[j] - np.cross(self.spin_gain[j], away)
        return gain, self.spin_gain[i] - self.spin_gain[j]

    def falling(self):
        """Bodies whose spins gain what gyroscopic torques add."""
        return self._replace(ahead=self.ahead_falling)

    def held(self):
        """Bodies that gain no velocity."""
        return self._replace(gain=0 * self.gain, spin_gain=0 * self.spin_gain, falls=0 * self.falls)

    def supported(self, impulses):
        """Bodies that fall and feel an impulse and its moment meanwhile [N s, N m s; W], shape (n, 6)."""
        gain = self.inverse_mass[:, None] * impulses[:, :3]
        spins = np.einsum("nij,nj->ni", self.inverse_inertia, impulses[:, 3:])
        spin_gain = self.spin_gain + spins
        ahead = np.array(self.ahead)
        for i in np.flatnonzero(self.moves):
            own = matrix(self.orientation[i]).T @ (self.spin[i] + spin_gain[i])
            ahead[i] = multiply(self.orientation[i], turn(own, self.h))
        return self._replace(gain=self.gain + gain, spin_gain=spin_gain, ahead=ahead)

    def relative(self, i, j):
        """Velocity [m/s] of centre of mass i and spin [rad/s] relative to body j as a rigid frame [W]."""
        away = self.position[i] - self.position[j]
        u = self.velocity[i] - self.velocity[j] - np.cross(self.spin[j], away)
        return u, self.spin[i] - self.spin[j]


def read(scene, state):
    """The bodies of a `dano.Scene` in a `dano.State`, as if all moved freely."""
    h = float(scene.timestep)
    moves = np.array([not body.fixed for body in scene.bodies])
    mass = np.array([float(body.mass * body.mass_scale) for body in scene.bodies])
    inertia = np.array([np.asarray(body.inertia * body.mass_scale) for body in scene.bodies])
    com = np.array([np.asarray(body.com + body.com_offset) for body in scene.bodies])
    position, orientation = np.asarray(state.position), np.asarray(state.orientation)
    velocity = np.where(moves[:, None], state.velocity, 0)
    omega = np.where(moves[:, None], state.omega, 0)
    rotations = np.array([matrix(q) for q in orientation])
    ahead = np.array([multiply(q, turn(w, h)) for q, w in zip(orientation, omega, strict=True)])
    falls = moves & (not scene.joints)
    gains = np.array(
        [gyroscopic_gain(w, J, h) if f else 0 * w for w, J, f in zip(omega, inertia, falls, strict=True)]
    )
    ahead_falling = np.array(
        [multiply(q, turn(w, h)) for q, w in zip(orientation, omega + gains, strict=True)]
    )
    return Bodies(
        h=h,
        gravity=np.asarray(scene.gravity),
        moves=moves,
        mass=mass,
        inertia=inertia,
        com=com,
        position=position,
        orientation=orientation,
        ahead=ahead,
        ahead_falling=ahead_falling,
        velocity=velocity,
        spin=np.einsum("nij,nj->ni", rotations, omega),
        gain=np.where(falls[:, None], h * np.asarray(scene.gravity), 0),
        spin_gain=np.einsum("nij,nj->ni", rotations, gains),
        falls=np.where(falls[:, None], h * np.asarray(scene.gravity), 0),
        inverse_mass=np.where(moves, 1 / mass, 0),
        inverse_inertia=np.array(
            [m * R @ np.linalg.inv(J) @ R.T for m, R, J in zip(moves, rotations, inertia, strict=True)]
        ),
    )
