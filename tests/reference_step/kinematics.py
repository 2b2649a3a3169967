"""Where bodies are and how they move, free or on joints: docs/theory/integrator.md, docs/joints.md.

Generalised velocities y are velocity and spin [W] of each free body, then one number for each joint
coordinate. Poses are functions of what a step makes of them, x(q ⊕ h y); all else is derived from these.
"""

import jax
import numpy as np
from reference_step.bodies import read
from reference_step.collision import on_bodies, unit, when_met
from reference_step.rotations import (
    conjugate,
    exponential,
    gyroscopic_gain,
    logarithm,
    matrix,
    momentum,
    multiply,
    spin_between,
    spin_with,
    turn,
)

SMALL = 1e-30
"""Imaginary part of a number by which is differentiated (Squire and Trapp 1998)."""


class Kinematics:
    """The bodies of a scene at a state.

    Attributes:
        bodies: As contact sees them, see `Bodies`.
        free: Indices of the bodies that move freely.
        start: y of the step before.
        before: Velocity [m/s] and spin [rad/s, W] of each body in the step before, shape (n, 6).
        jacobian: J = ∂x/∂q at the start, shape (n, 6, k).
        offset: c, so that J y + c is the step's motion at the old y, shape (n, 6).
        mass_matrix: Σ Jᵀ M J and the armatures, shape (k, k).
        joint_rows: Of each joint the places of its coordinates among y, or of those of the one it mimics.
    """

    def __init__(self, scene, state):
        scene = jax.tree.map(np.asarray, scene)  # quicker to read
        self.scene, self.bodies, self.h = scene, read(scene, state), float(scene.timestep)
        self.names, self.joints, self.closing = list(scene.names), scene.joints, scene.loops
        self.hangs = {self.names.index(joint.child): joint for joint in self.joints}
        moves = self.bodies.moves
        self.met, self.lead = np.zeros(len(self.names)), np.ones(len(self.names))
        self.held, self.on_way = np.zeros(len(self.names)), np.zeros((len(self.names), 6))
        self.supports = np.zeros((len(self.names), 6))
        self.free = [i for i in range(len(self.names)) if moves[i] and i not in self.hangs]
        self.joint_rows, size = {}, 6 * len(self.free)
        for joint in self.joints:
            if joint.mimics is None:
                width = {"hinge": 1, "slide": 1, "ball": 3, "planar": 3, "weld": 0}[joint.kind]
                self.joint_rows[joint.child], size = list(range(size, size + width)), size + width
        for joint in self.joints:
            if joint.mimics is not None:
                self.joint_rows[joint.child] = self.joint_rows[joint.mimics]
        roots = [np.r_[self.bodies.velocity[i], self.bodies.spin[i]] for i in self.free]
        joints = [] if state.v is None else [np.asarray(state.v)]
        self.start = np.concatenate([*roots, *joints, np.zeros(0)])
        self.q = np.concatenate(
            [np.zeros(6 * len(self.free)), *([] if state.q is None else [np.asarray(state.q)])]
        )
        self.now = self.placed(0 * self.start)
        self._complete()

    def _complete(self):
        """What follows from the poses of the start, of a step before, and of a step ahead."""
        bodies, h = self.bodies, self.h
        earlier, ahead = self.placed(-self.start), self.placed(self.start)
        position, orientation = (np.array(x) for x in zip(*self.now, strict=True))
        R = np.array([matrix(q) for q in orientation])
        self.bodies = bodies = bodies._replace(
            position=position, orientation=orientation, ahead=np.array([q for _, q in ahead])
        )
        if self.joints:
            self.bodies = bodies = bodies._replace(ahead_falling=bodies.ahead)
        self.before = np.concatenate([bodies.velocity, bodies.spin], axis=1)
        for i in self.hangs:
            omega = spin_between(earlier[i][1], orientation[i], h)
            self.before[i] = np.r_[(position[i] - earlier[i][0]) / h, R[i] @ omega]
        self.jacobian = self._jacobian()
        self.offset = self.twists(self.start) - self.jacobian @ self.start
        seen = self.seen(self.start)
        inertia = R @ bodies.inertia @ R.transpose(0, 2, 1)
        v, w = self.jacobian[:, :3], self.jacobian[:, 3:]
        M = np.einsum("n,nak,nal->kl", bodies.mass, v, v) + np.einsum("nak,nab,nbl->kl", w, inertia, w)
        for joint in self.joints:
            if joint.armature is not None:
                rows = self.joint_rows[joint.child]
                M[rows, rows] += float(joint.armature) * factor_of(joint) ** 2
        self.mass_matrix = M
        inverse = self.jacobian @ np.linalg.inv(M) @ self.jacobian.transpose(0, 2, 1)
        self.bodies = bodies._replace(
            velocity=seen[:, :3],
            spin=seen[:, 3:],
            inverse_mass=np.sqrt(np.sum(inverse[:, :3, :3] ** 2, axis=(1, 2)) / 3),
            inverse_inertia=inverse[:, 3:, 3:],
        )

    def joint_turn(self, joint, y):
        """Quaternion and length along the axes by which a joint has moved, a step h y after the start."""
        rows, axis = self.joint_rows[joint.child], np.asarray(joint.axis)
        if joint.kind == "weld":
            return np.array([1, 0, 0, 0]), np.zeros(3)
        if joint.kind == "ball":
            return multiply(exponential(self.q[rows]), turn(y[rows], self.h)), np.zeros(3)
        value = self.q[rows] + self.h * y[rows]
        if joint.kind == "planar":
            first, second = plane(axis)
            return exponential(value[2] * axis), value[0] * first + value[1] * second
        value = float(joint.ratio) * value[0] + float(joint.shift) if joint.mimics else value[0]
        if joint.kind == "hinge":
            return exponential(value * axis), np.zeros(3)
        return np.array([1, 0, 0, 0]), value * axis

    def placed(self, y):
        """Centre of mass [m, W] and orientation of each body a step h y after the start."""
        bodies, com = self.bodies, self.bodies.com
        found = [(x, q) for x, q in zip(bodies.position, bodies.orientation, strict=True)]
        for r, i in enumerate(self.free):
            v, w = y[6 * r : 6 * r + 3], y[6 * r + 3 : 6 * r + 6]
            x, q = found[i]
            found[i] = x + self.h * v, multiply(q, turn(matrix(q).T @ w, self.h))
        done = {i for i in range(len(found)) if i not in self.hangs}

        def place(i):
            if i in done:
                return found[i]
            joint = self.hangs[i]
            origin, q = np.zeros(3), np.array([1, 0, 0, 0])
            if joint.parent is not None:
                parent = self.names.index(joint.parent)
                x, q = place(parent)
                origin = x - matrix(q) @ com[parent]
            turned, path = self.joint_turn(joint, y)
            rest = multiply(q, np.asarray(joint.orientation))
            pivot = (
                origin
                + matrix(q) @ np.asarray(joint.position)
                + matrix(rest) @ (np.asarray(joint.anchor) + path)
            )
            child = multiply(rest, turned)
            found[i] = pivot + matrix(child) @ (com[i] - np.asarray(joint.anchor)), child
            done.add(i)
            return found[i]

        return [place(i) for i in range(len(found))]

    def _jacobian(self):
        columns = []
        for k in range(len(self.start)):
            moved = self.placed(1j * SMALL * np.eye(len(self.start))[k])
            column = []
            for (_, q), (x, turned) in zip(self.now, moved, strict=True):
                change = multiply(turned.imag, conjugate(q))
                column.append(np.r_[x.imag, 2 * change[1:]] / (SMALL * self.h))
            columns.append(column)
        n = len(self.now)
        return np.array(columns).transpose(1, 2, 0) if columns else np.zeros((n, 6, 0))

    def seen(self, y):
        """Velocity and spin [W] of all bodies as contact sees them, J y + c."""
        return self.jacobian @ y + self.offset

    def twists(self, y):
        """V_i(y): velocity and spin [W] that lead each body from its pose to that of the end."""
        found = np.zeros((len(self.now), 6))
        ahead = self.placed(y)
        for i in self.hangs:
            (x, q), (x_end, q_end) = self.now[i], ahead[i]
            found[i] = np.r_[(x_end - x) / self.h, matrix(q) @ spin_between(q, q_end, self.h)]
        for r, i in enumerate(self.free):
            found[i] = y[6 * r : 6 * r + 6]
        return found

    def momenta(self, y, control):
        """m (v⁺ − v) − h m g − h f and R (P(ω⁺) − P⁻(ω)) − h τ of each body [W], shape (n, 6)."""
        bodies, h = self.bodies, self.h
        gained = np.zeros((len(bodies.mass), 6))
        for i, (v, before) in enumerate(zip(self.twists(y), self.before, strict=True)):
            if not bodies.moves[i]:
                continue
            R, J = matrix(bodies.orientation[i]), bodies.inertia[i]
            R_met = self.rotation_met(i)
            spin = R_met @ momentum(R_met.T @ v[3:], J, h, self.lead[i]) - R @ momentum(
                R.T @ before[3:], J, h, -1
            )
            gained[i] = np.r_[bodies.mass[i] * (v[:3] - before[:3] - h * bodies.gravity), spin]
            gained[i] -= self.supports[i]
            if control is not None:
                gained[i] -= h * np.r_[np.asarray(control.force)[i], np.asarray(control.torque)[i]]
        return gained

    def balance_when_met(self, found):
        """Take when bodies meet, and what they rest on until then."""
        for p in found:
            if any(p.waits):
                support = p.part * p.delays * on_bodies(self.bodies, p.first, p.second, p.support)
                self.supports += (0.5 + p.share) * support
                self.on_way += (0.5 + 0.5 * p.share) * support
            if p.holds:
                self.held[list(p[:2])] = True
        for i in self.free:
            self.met[i], beta = when_met(found, i)
            self.lead[i] = 1 - beta

    def push(self, control):
        """Take forces and torques of the step as part of what moves bodies until they meet."""
        if control is not None:
            self.on_way += self.h * np.c_[np.asarray(control.force), np.asarray(control.torque)]

    def moved(self, y):
        """y by which positions change: bodies go on as before until they meet."""
        bodies, found = self.bodies, np.array(y)
        for r, i in enumerate(self.free):
            if self.lead[i] < 1:
                falls, met = 1 - self.held[i], self.met[i]
                before = np.r_[bodies.velocity[i] + falls * bodies.gain[i], bodies.spin[i]]
                before[3:] += falls * (1 - self.lead[i]) * (0.5 + met) * bodies.spin_gain[i]
                before[:3] += bodies.inverse_mass[i] * self.on_way[i, :3]
                before[3:] += bodies.inverse_inertia[i] @ self.on_way[i, 3:]
                rows = slice(6 * r, 6 * r + 6)
                found[rows] = (1 - met) * y[rows] + met * before
        return found

    def rotation_met(self, i):
        """Rotation of a body when its angular momentum is balanced."""
        q, ahead = self.bodies.orientation[i], self.bodies.ahead_falling[i]
        return matrix(unit(q + self.met[i] * (ahead - q)))

    def turn_in_impact(self, i, w):
        """What a body turns by in the step besides the spin of the balance w [rad/s, W]."""
        R, J, h, met = self.rotation_met(i), self.bodies.inertia[i], self.h, self.met[i]
        seen = R.T @ w
        after = spin_with(momentum(seen, J, h, self.lead[i]), seen, J, h, 1 - 2 * met)
        gains = R @ gyroscopic_gain(after, J, h) - self.bodies.spin_gain[i]
        return R @ (after - seen) + met**2 / 2 * gains

    def spin_after_impact(self, i, w, orientation):
        """Spin at the end of the step [B], of a body whose balance gives w [rad/s, W]."""
        R, J, h = self.rotation_met(i), self.bodies.inertia[i], self.h
        L = R @ momentum(R.T @ w, J, h, self.lead[i])
        return spin_with(matrix(orientation).T @ L, R.T @ w, J, h, -1)

    def balanced(self, i, omega, orientation):
        """The spin [W] of the balance that leads to a spin [B] and an orientation at the end of a step."""
        R, R_met, J, h = matrix(orientation), self.rotation_met(i), self.bodies.inertia[i], self.h
        return R_met @ spin_with(R_met.T @ R @ momentum(omega, J, h, -1), omega, J, h, self.lead[i])

    def gaps(self, y):
        """φ: how far loops are open after a step; distances [m, W], then turns of welds [rad]."""
        poses, distances, turns = self.placed(y), [], []
        for loop in self.closing:
            ends = []
            for name, point in ((loop.first, loop.position), (loop.second, loop.anchor)):
                i = None if name is None else self.names.index(name)
                x, q = (np.zeros(3), np.array([1, 0, 0, 0])) if i is None else poses[i]
                com = 0 if i is None else self.bodies.com[i]
                ends.append((x + matrix(q) @ (np.asarray(point) - com), q))
            (a, p), (b, q) = ends
            distances.append(b - a)
            if loop.kind == "weld":
                off = multiply(conjugate(multiply(p, np.asarray(loop.orientation))), q)
                turns.append(2 * np.sign(off[0].real) * off[1:])
        return np.concatenate([*distances, *turns, np.zeros(0)])

    def gap_slopes(self):
        """G = ∂φ/∂q at the start."""
        k = len(self.start)
        steps = (self.gaps(1j * SMALL * e).imag / (SMALL * self.h) for e in np.eye(k))
        return np.array(list(steps)).T.reshape(-1, k)

    def end(self, y):
        """The state at the end of a step with y, as arrays by name."""
        twists, rows, moved = self.twists(y), slice(6 * len(self.free), None), self.moved(y)
        omega = [matrix(q).T @ V[3:] for (_, q), V in zip(self.now, twists, strict=True)]
        for r, i in enumerate(self.free):
            if self.lead[i] < 1:
                moved[6 * r + 3 : 6 * r + 6] += self.turn_in_impact(i, twists[i][3:])
        poses = self.placed(moved)
        for i in self.free:
            if self.lead[i] < 1:
                omega[i] = self.spin_after_impact(i, twists[i][3:], poses[i][1])
        q = (self.q + self.h * y)[rows]
        for joint in self.joints:
            if joint.kind == "ball":
                places = np.array(self.joint_rows[joint.child])
                q[places - rows.start] = logarithm(self.joint_turn(joint, y)[0])
        return {
            "position": np.array([x for x, _ in poses]),
            "orientation": np.array([q for _, q in poses]),
            "velocity": twists[:, :3],
            "omega": np.array(omega),
            "q": q,
            "v": y[rows],
        }


def factor_of(joint):
    """How far a joint moves per coordinate: its ratio, or one."""
    return float(joint.ratio) if joint.mimics else 1.0


def plane(axis):
    """The two directions in which the lengths of a planar joint are measured."""
    start = np.eye(3)[0 if abs(axis[0]) < 0.99 else 1]
    first = start - (axis @ start) * axis
    first = first / np.linalg.norm(first)
    return first, np.cross(axis, first)
