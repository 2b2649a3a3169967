"""First impacts of the dropped squares: how many are one impact, and what laws of one impact say of these.

Nothing but the poses is used: the flight before and the flight after are fitted, and the impact is where the
centre's two paths meet. If the angles differ there, the square had another spin in between: two corners hit,
one after the other. Where they agree it was one impact, and the flights say the velocities before and after.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import NO_DATA, Source
from benchmarks.real._points import newton, SIX_LAWS
from benchmarks.real._squares import begun, Drops, drops, FRAME, GRAVITY, HALF, lowest, scene

CLEAR = 0.004
"""A square flies while no corner is nearer to the floor [m]: a frame of the fall is 10 mm."""
FRAMES = (5, 12)
"""Frames of a flight that are fitted: at least, at most. Air takes little in 50 ms."""

ONE_IMPACT = np.radians(3.0)
"""How much the angles of the two flights may differ where they meet."""
FLAT = np.radians(10.0)
"""Below this tilt a face hits, whatever the angles say."""
BANDS = (0, 10, 20, 30, 45)
"""Of the tilt [°]."""

GROUP = "First impacts of a square"
TIMESTEP, N_STEPS, GAP, STIFFNESS = 1e-5, 80, 1e-6, 1e11
"""Of impacts by dano: s, steps, m, Pa/m."""
WEIGHTS = (0.15, 0.15, 4.0)
"""Of velocities [m/s] and spins [rad/s], as for the ellipse."""


@dataclass(frozen=True)
class FirstImpacts:
    """Impacts as two flights that meet, in axes where θ turns z into x, as `_points` has it.

    Attributes:
        tilt: Angle from lying flat, within ±π/4 [rad], shape (n,).
        before: Velocities along x and z, and spin, before [m/s, rad/s], shape (n, 3).
        after: The same after.
        turned: By how much the angles of the flights differ where they meet [rad], shape (n,).
        deep: How far below the floor a sharp corner would be there [m], shape (n,).
    """

    tilt: np.ndarray
    before: np.ndarray
    after: np.ndarray
    turned: np.ndarray
    deep: np.ndarray

    @classmethod
    def of(cls, seen: Drops) -> "FirstImpacts":
        """Of the drops whose flights before and after have frames enough."""
        found = [one for poses in seen.poses if (one := _met(poses)) is not None]
        tilt, before, after, turned, deep = (np.array(each) for each in zip(*found, strict=True))
        return cls(tilt, before, after, turned, deep)

    def __len__(self) -> int:
        return len(self.tilt)

    def single(self) -> "FirstImpacts":
        """Those that were one impact, of one corner."""
        chosen = (np.abs(self.turned) < ONE_IMPACT) & (np.abs(self.tilt) > FLAT)
        return FirstImpacts(
            self.tilt[chosen],
            self.before[chosen],
            self.after[chosen],
            self.turned[chosen],
            self.deep[chosen],
        )

    @property
    def arm(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the lowest corner is, from the centre: along the floor and below [m]."""
        sine, cosine = np.sin(np.abs(self.tilt)), np.cos(self.tilt)
        return np.sign(self.tilt) * HALF * (cosine - sine), HALF * (cosine + sine)


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """What first impacts are, and the six laws on those that are one."""
    if source is None:
        return [skipped(GROUP, "all of them", NO_DATA)]
    one, two = drops(source)
    fitted, held = FirstImpacts.of(one), FirstImpacts.of(two)
    found = _kinds(fitted, held)
    fitted, held = fitted.single(), held.single()
    gyration = _gyration(fitted)
    found.append(Row(GROUP, "radius of gyration from the impulses", 1e3 * gyration, "mm", note="fitted half"))
    note = f"{len(fitted)} fitted, {len(held)} held"
    off, best = {}, np.zeros(2)
    for name, law in SIX_LAWS.items():
        x = _tuned(law, gyration, fitted)
        off[name] = law(held.before, held.arm, gyration, *x) - held.after, _words(x)
        best = x if name == "Mirtich" else best
    off["dano, in time, with Mirtich's constants"] = by_dano(held, gyration, *best) - held.after, ""
    nothing = newton(held.before, held.arm, gyration, 0.0, 0.0)
    off["no restitution, no friction"] = nothing - held.after, ""
    group = f"{GROUP}: those that are one impact"
    for name, (after, constants) in off.items():
        for words, values, unit in (
            ("velocity after, median error", np.linalg.norm(after[:, :2], axis=1), "m/s"),
            ("spin after, median error", np.abs(after[:, 2]), "rad/s"),
        ):
            low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
            said = f"± {_of_median(values):.2g}; {constants}{note}"
            found.append(Row(group, f"{name}: {words}", middle, unit, quartiles=(low, high), note=said))
    return found


def _kinds(fitted: FirstImpacts, held: FirstImpacts) -> list[Row]:
    turned = np.degrees(np.abs(np.concatenate([fitted.turned, held.turned])))
    tilt = np.degrees(np.abs(np.concatenate([fitted.tilt, held.tilt])))
    found = []
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        chosen = (tilt >= low) & (tilt < high)
        share = 100 * float(np.mean(turned[chosen] > np.degrees(ONE_IMPACT)))
        note = f"{int(chosen.sum())} drops; median {np.median(turned[chosen]):.1f}°"
        found.append(
            Row(GROUP, f"angles differ by 3° or more, tilted by {low} to {high}°", share, "%", note=note)
        )
    share = 100 * float(np.mean(turned > np.degrees(ONE_IMPACT)))
    found.append(Row(GROUP, "angles differ by 3° or more", share, "%", note=f"of {len(turned)} drops"))
    for words, each in (("fitted half", fitted.single()), ("held half", held.single())):
        deep = 1e3 * np.quantile(each.deep, (0.25, 0.5, 0.75))
        name = f"a sharp corner would be below the floor by, {words}"
        note = f"{len(each)} drops that are one impact"
        found.append(Row(GROUP, name, float(deep[1]), "mm", quartiles=(deep[0], deep[2]), note=note))
    return found


def _met(poses: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float, float] | None:
    """Tilt, velocities before and after, difference of the angles, and depth; None without two flights."""
    # The recording ends every flight.
    flies = np.append(lowest(poses) > CLEAR, False)
    fall = int(np.argmin(flies))
    again = fall + int(np.argmax(flies[fall:]))
    lands = again + int(np.argmin(flies[again:]))
    # The frame before the impact is the tracker's mean over some of it.
    first, second = np.arange(max(0, fall - FRAMES[1]), fall), np.arange(again, min(lands, again + FRAMES[1]))
    if len(first) < FRAMES[0] or len(second) < FRAMES[0]:
        return None
    one, two = (_flight(frames, poses[frames]) for frames in (first, second))
    # Both fall alike: the difference of heights is linear.
    gap, closing = two[1] - one[1]
    if closing <= 0:
        return None
    time = -gap / closing
    if not (first[-1] - 1) * FRAME < time < (second[0] + 1) * FRAME:
        return None
    (x, _), (z, _), (angle, _) = (line @ [[1, 0], [time, 1]] for line in one)
    turned = two[2] @ [1, time] - angle
    quarter = np.pi / 2
    middle = angle + turned / 2
    tilt = np.mod(middle + quarter / 2, quarter) - quarter / 2
    height = z - GRAVITY * time**2 / 2
    before, after = (np.array([-v[0, 1], v[1, 1] - GRAVITY * time, v[2, 1]]) for v in (one, two))
    deep = -float(lowest(np.array([x, height, middle])))
    return float(tilt), before, after, float(turned), deep


def _flight(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Lines (value at time 0, rate) of x, of z without its fall, and of θ, shape (3, 2)."""
    times = FRAME * frames
    free = poses + np.array([0.0, 1.0, 0.0]) * (GRAVITY * times**2 / 2)[:, None]
    return np.polynomial.polynomial.polyfit(times, free, 1).T


def _gyration(impacts: FirstImpacts) -> float:
    """Radius with which the change of spin is the moment of the change of velocity, for any law."""
    along, below = impacts.arm
    change = impacts.after - impacts.before
    moment = -(along * change[:, 1] + below * change[:, 0])
    # Medians of ratios: some impacts have a patch.
    large = np.abs(change[:, 2]) > 5.0
    return float(np.sqrt(np.median(moment[large] / change[large, 2])))


def _tuned(law, gyration: float, fitted: FirstImpacts) -> np.ndarray:
    def misfit(x: np.ndarray) -> float:
        off = (law(fitted.before, fitted.arm, gyration, *x) - fitted.after) / WEIGHTS
        size = np.linalg.norm(off, axis=1)
        return float(np.mean(size / (1 + size)))

    return minimize(misfit, [0.5, 0.2], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-5}).x


def _words(x: np.ndarray) -> str:
    return f"restitution {x[0]:.3f}, friction {x[1]:.3f}; "


def by_dano(impacts: FirstImpacts, gyration: float, e: float, friction: float) -> np.ndarray:
    """Velocities after, by a spring that turns the square round in half a millisecond."""
    made = scene(TIMESTEP, friction, e, 1.0, gyration, stiffness=STIFFNESS, gravity=0.0)
    _, below = impacts.arm
    q = np.stack([np.zeros(len(impacts)), below + GAP, impacts.tilt], axis=-1)
    runs = dano.rollouts(made, begun(made, q, impacts.before * [-1, 1, 1]), N_STEPS, keep="last")
    if not bool(np.all(runs.converged)) or float(lowest(np.asarray(runs.states.q)[:, -1]).min()) <= 0:
        raise ValueError("an impact was not solved, or has not ended")
    return np.asarray(runs.states.v)[:, -1] * [-1, 1, 1]


def _of_median(values: np.ndarray) -> float:
    drawn = np.random.default_rng(0).integers(0, len(values), (1000, len(values)))
    return float(np.std(np.median(values[drawn], axis=1)))
