"""One step: docs/theory/integrator.md. Everything is a root R(y) = 0, searched with a plain Newton method."""

import numpy as np
from reference_step.collision import find
from reference_step.joint_law import JointLaw
from reference_step.kinematics import Kinematics
from reference_step.law import relative, wrench
from reference_step.patches import patch_map, patch_wrench, patches_of

SOLVED, GOOD = 1e-12, 1e-9
"""What a step may miss, see `missed`, where a search ends, and for a root if it gets no further."""
SOFTEST = 1e6
"""The solver begins with stiction velocities so many times as large."""


class Step:
    """The equations of a step.

    Args:
        scene: A `dano.Scene`.
        state: A `dano.State` of it.
        control: A `dano.Control`, or None.
        shares: τ of some pairs by (sampled body, other body), instead of the exact ones.
    """

    def __init__(self, scene, state, control=None, shares=None):
        self.kinematics = Kinematics(scene, state)
        self.scene, self.control, self.h = self.kinematics.scene, control, self.kinematics.h
        self.joints = JointLaw(self.kinematics, control)
        self.given = find(self.scene, self.kinematics.bodies, shares)
        self.points = list(self.given)
        self.kinematics.balance_when_met(self.given)
        self.kinematics.push(control)
        self.patches = patches_of(self.scene, self.kinematics.bodies)
        self.loops = self.kinematics.gap_slopes()
        self.start = np.r_[self.kinematics.start, np.zeros(len(self.loops))]
        self.kept = None, None
        self.scale = 1 / np.r_[np.diag(self.kinematics.mass_matrix), np.full(len(self.loops), self.h)]

    def residual(self, unknowns, softness=1.0):
        """R: what the equations miss at y and the forces λ of loops, as velocities [m/s, rad/s]."""
        y, loads = np.split(unknowns, [len(self.kinematics.start)])
        forces = self.joints.forces(y, softness)[0] - self.contact(y, softness)[0] - self.loops.T @ loads
        return self.scale * (self.momenta(y) + np.r_[self.h * forces, np.zeros(len(loads))])

    def jacobian(self, unknowns, softness=1.0):
        """∂R/∂(y, λ): that of momenta and gaps by differences, that of the laws in closed form."""
        y, loads = np.split(unknowns, [len(self.kinematics.start)])
        slopes = np.diag(self.joints.forces(y, softness)[1]) - self.contact(y, softness)[1]
        by_y = self.momenta_jacobian(y) + self.h * np.r_[slopes, np.zeros((len(loads), len(y)))]
        by_loads = np.r_[-self.h * self.loops.T, np.zeros((len(loads), len(loads)))]
        return self.scale[:, None] * np.c_[by_y, by_loads]

    def momenta_jacobian(self, y):
        """∂(momenta)/∂y by differences; kept while y changes little, because it takes most of the time."""
        at, slopes = self.kept
        size = 1 + np.abs(y).max(initial=0)
        if at is None or np.abs(y - at).max(initial=0) > 1e-2 * size:
            steps = 1e-5 * size * np.eye(len(y))
            slopes = np.array([self.momenta(y + e) - self.momenta(y - e) for e in steps]).T / (2e-5 * size)
            self.kept = y, slopes
        return slopes

    def momenta(self, y):
        """Σ Jᵀ (P(V(y)) − P⁻ − h f), and the gaps of loops at the end."""
        own = np.einsum("iak,ia->k", self.kinematics.jacobian, self.kinematics.momenta(y, self.control))
        return np.r_[own, self.kinematics.gaps(y)]

    def contact(self, y, softness=1.0):
        """Generalised forces of contact and their derivative by y."""
        J, V = self.kinematics.jacobian, self.kinematics.seen(y)
        force, slopes = np.zeros_like(y), np.zeros((len(y), len(y)))
        for points in self.points:
            found = wrench(points, V, softness)
            force += J[points.first].T @ found.first + J[points.second].T @ found.second
            T = relative(points) @ np.r_[J[points.first], J[points.second]]
            slopes += T.T @ found.slope @ T
        for patch in self.patches:
            T = patch_map(patch) @ np.r_[J[patch.first], J[patch.second]]
            found, slope = patch_wrench(patch, V, softness)
            force, slopes = force + T.T @ found, slopes + T.T @ slope @ T
        return force, slopes

    def take_restitution(self, share):
        """Take a share of the restitution in what follows, where impacts end within the step."""
        for n, points in enumerate(self.given):
            if not points.law.compliant:
                self.points[n] = points._replace(law=points.law._replace(e=share * points.law.e))

    def adds_energy(self, y):
        """Whether contact adds more than a thousandth of the energy that it moves between coordinates."""
        k = self.kinematics
        own = np.einsum("iak,ia->k", k.jacobian, k.momenta(y, self.control)) + self.h * self.joints.smooth(y)
        start = np.array(k.start)
        for r, i in enumerate(k.free):
            # An impact begins with the spin of its moment.
            start[6 * r + 3 : 6 * r + 6] += (1 - k.lead[i]) * (0.5 + k.met[i]) * k.bodies.spin_gain[i]
        work = 0.5 * own * (start + y)
        return np.sum(work) > 1e-3 * np.sum(0.5 * np.abs(own) * (np.abs(start) + np.abs(y)))


def newton(step, start, softness, enough, most=50):
    """Newton's method with shortened steps, until little is missed: the unknowns, and what they miss."""
    x, best, idle = start, (np.inf, start), 0
    for _ in range(most):
        R, slope = step.residual(x, softness), step.jacobian(x, softness)
        error = missed(R, slope, x)
        if error < 0.5 * best[0]:
            best, idle = (error, x), 0
        idle += 1
        if best[0] <= enough or (best[0] <= GOOD and idle > 4):
            break
        change, tried = np.linalg.lstsq(slope, -R, rcond=1e-14)[0], []
        for share in (1.0, 0.5, 0.2, 0.1, 0.03, 0.01, 0.001):
            trial = x + share * change
            tried.append((np.linalg.norm(step.residual(trial, softness)), trial))
            if tried[-1][0] < np.linalg.norm(R):
                break
        x = min(tried, key=lambda found: found[0])[1]
    return best[1], best[0]


def missed(R, slope, x):
    """Largest residual over 1 + the largest velocity, without what comes from rounding of the unknowns.

    That is no more than a millionth: far from a root everything is large.
    """
    size = 1 + np.abs(x).max()
    rounded = np.minimum(1e-15 * np.abs(slope) @ np.abs(x), 1e-6 * size)
    return np.max(np.abs(R) - rounded) / size


def root(step):
    """y of a step: the root near the old velocities, or from rest, or from large stiction velocities on.

    Raises:
        ArithmeticError: If none is found.
    """
    x, error = newton(step, step.start, 1.0, SOLVED, 12)
    if error > GOOD:
        x, error = newton(step, 0 * step.start, 1.0, SOLVED, 12)
    for factor in (4.0, 1.5):
        if error > GOOD:
            x, error = followed(step, factor)
    if error > GOOD:
        raise ArithmeticError(f"no root found: the equations miss {error} m/s or rad/s")
    return x[: len(step.kinematics.start)]


def followed(step, factor):
    """The root followed while stiction velocities shrink by a factor; with nothing slipping, on a line."""
    last, x, softness = None, step.start, SOFTEST
    while True:
        solved, error = newton(step, x, softness, SOLVED if softness == 1 else GOOD)
        if softness == 1:
            return solved, error
        lower = max(softness / factor, 1.0)
        ahead = 0.0 if last is None else (solved - last[1]) / (softness - last[0])
        last, x, softness = (softness, solved), solved + ahead * (lower - softness), lower


def step(scene, state, control=None, shares=None):
    """The state after a step, as arrays by name, and the equations of the step; see `Step`.

    Raises:
        ArithmeticError: If no root was found.
    """
    equations = Step(scene, state, control, shares)
    y = settled(equations)
    return equations.kinematics.end(y), equations


def settled(equations):
    """The root of a step, with as much of the restitution as adds no energy."""
    hits = any(np.any(points.impact > 0) for points in equations.points)
    y, tenths = root(equations), 10
    while hits and tenths > 0 and equations.adds_energy(y):
        tenths -= 1
        equations.take_restitution(tenths / 10)
        y = root(equations)
    return y
