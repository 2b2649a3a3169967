"""1,718 impacts of an ellipse on a floor, one by one: the velocity after each from that before.

An ellipse of 70 by 50 mm falls between two panes (MCube Lab, MIT: planar-impact-dataset). The file brings
what six laws say, and the Jacobian of the contact that they were computed with. **The row of that Jacobian
along the floor has the wrong sign**: it takes x and θ for right-handed, but the recorded motion is
left-handed. Friction then turns the ellipse the wrong way in all six, and a third of the measured spin seems
to need moments that no point contact has. `_jacobian` shows it from the recordings alone; dano's scene has
its joint turn z into x.
"""

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import Impacts, NO_DATA, Source
from benchmarks.real._points import arms, at_contact, following_slip, moment_left, newton, SIX_LAWS

SEMI_AXES = (0.035, 0.025)  # m
THICKNESS = 0.010  # m, half; nothing depends on it
MASS = 0.0364  # kg
GYRATION = 0.00037**0.5  # m, by which the velocities of the six laws follow from their impulses


@dataclass(frozen=True)
class Impulse:
    """How an impact is simulated.

    Attributes:
        timestep: [s].
        n_steps: Until the plate has left the floor.
        gap: To the floor at the start, so that the first step begins outside of it [m].
        compliant: Whether the impact takes the time that a spring needs; else it ends within a step.
    """

    timestep: float
    n_steps: int
    gap: float
    compliant: bool


WITHIN_A_STEP = Impulse(2e-4, 10, 1e-5, False)
"""Until the lowest point has sunk in by some tenths of a millimetre at 2.6 m/s."""
IN_TIME = Impulse(2e-5, 50, 1e-6, True)
"""By a spring that turns the plate round in .7 ms. A stiffness of a tenth or ten times as much, with steps to
match, changes velocities by some mm/s."""
STIFFNESS = 1e11  # Pa/m

# Weights of a fit: what two constants leave of velocities [m/s] and of spins [rad/s], and from how many of
# these a residual counts linearly.
NOISE = {"velocity": 0.15, "omega": 4.0}
HUBER = 1.5

# Impacts whose states differ by less than this count as repeats: cos 2θ and sin 2θ, then velocities and spin.
ALIKE = (0.1, 0.1, 0.1, 0.15, 2.0)

PARTS_OF_HALF = 6

VELOCITY, SPIN = "velocity after, median error", "spin after, median error"


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Fit two constants, predict the held impacts, and put others beside it."""
    if source is None:
        return [skipped("Impacts of an ellipse", "all of them", NO_DATA)]
    fitted, held = source.split("impacts.npz", Impacts.load)
    if quick:
        fitted = fitted.some(np.arange(60))
    group = "Impacts of an ellipse: dano"
    found, off, constants = [], {}, {}
    for kind, label, targets in ((WITHIN_A_STEP, WITHIN, (None, None)), (IN_TIME, "", (0.56, 20.0))):
        fit = identify(fitted, kind)
        constants = {name: float(fit.values[name]) for name in PARAMETERS}
        note = f"{source.words}; {len(held)} impacts"
        after = simulated(held, **constants, kind=kind)
        off[kind] = np.linalg.norm((after - held.after[:, 3:])[:, :2], axis=1)
        of_kind = _errors(group, held, after, name=label, targets=targets, note=note)
        for name in PARAMETERS:
            low, high = fit.interval(name)
            words = f"{label}: {name}" if label else name
            of_kind.append(Row(group, words, constants[name], "", note=f"95 % {low:.3f} to {high:.3f}"))
        if kind is IN_TIME and not quick:
            of_kind += _between_parts(group, fitted, fit)
        found = of_kind + found
    less, error = _paired(off[IN_TIME], off[WITHIN_A_STEP])
    found.append(
        Row(group, "velocity error less that of impacts within a step", less, "m/s", 0.0, note=error)
    )
    others = [*_others(fitted, held), *_laws(fitted, held)]
    return [*found, *others, *_repeats(held, constants), *_jacobian(held)]


WITHIN = "impacts within a step"

PARAMETERS = {
    "friction": dano.Parameter("friction", lambda s: s.contact("plate", "floor").sliding_friction, 0.02, 1.0),
    "restitution": dano.Parameter("restitution", lambda s: s.contact("plate", "floor").restitution, 0.1, 1.0),
}


def scene(kind: Impulse = IN_TIME, friction: float = 0.3, restitution: float = 0.5) -> dano.Scene:
    """The ellipse between its panes: a planar joint whose angle turns z into x, as the recordings have it.

    The impact is all there is, so there is no gravity.
    """
    a, b = SEMI_AXES
    inertia = MASS * GYRATION**2 * np.eye(3)
    plate = dano.Body("plate", dano.Ellipsoid((a, THICKNESS, b)), mass=MASS, inertia=inertia)
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    panes = dano.Joint(None, "plate", "planar", axis=(0, 1, 0), position=(0, 0, 1))
    constants = {"sliding_friction": friction, "restitution": restitution}
    law = dano.DistributedLaw()
    if kind.compliant:
        # All that is lost is lost at any speed, as far as the restitution asks for it.
        constants |= {"stiffness": STIFFNESS, "hysteresis": 1.0}
        law = dano.DistributedLaw(compliant=True, implicitness=0.5)
    return dano.Scene.create(
        [plate, floor],
        [dano.Contact("plate", "floor", dano.ContactParams(**constants), law=law)],
        joints=[panes],
        timestep=kind.timestep,
        gravity=(0, 0, 0),
    )


def identify(
    impacts: Impacts,
    kind: Impulse = IN_TIME,
    *,
    independent: str = "numbers",
    after: dano.Identification | None = None,
) -> dano.Identification:
    """Friction and restitution by `dano.identify`, each impact a motion of two frames."""
    options = dano.IdentifyOptions(huber=HUBER, independent=independent)
    motions = [_motion(impacts, kind, i) for i in range(len(impacts))]
    with warnings.catch_warnings():
        # That a frame takes the body less far than its size, or that residuals are those of a law.
        warnings.simplefilter("ignore")
        return dano.identify(
            scene(kind),
            motions,
            list(PARAMETERS.values()),
            initial="given",
            noise=NOISE,
            after=after,
            options=options,
        )


def simulated(
    impacts: Impacts, *, friction: float, restitution: float, kind: Impulse = IN_TIME
) -> np.ndarray:
    """Velocities after each impact by dano [m/s, rad/s], shape (n, 3)."""
    made = scene(kind, friction, restitution)
    height = arms(impacts.before[:, 2], SEMI_AXES)[1] + kind.gap
    # The joint counts z downwards, from where `position` has it.
    q = np.stack([impacts.before[:, 0], 1 - height, impacts.before[:, 2]], axis=-1)
    v = impacts.before[:, 3:] * [1, -1, 1]
    one = made.initial_state()
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(q), *x.shape)), one)
    states = eqx.tree_at(lambda s: (s.q, s.v), many, (jnp.asarray(q), jnp.asarray(v)))
    runs = dano.rollouts(made, jax.vmap(made.filled)(states), kind.n_steps, keep="last")
    if not bool(np.all(runs.converged)):
        raise ValueError(f"{int(np.sum(~np.asarray(runs.converged)))} impacts were not solved")
    return np.asarray(runs.states.v)[:, -1] * [1, -1, 1]


def _motion(impacts: Impacts, kind: Impulse, i: int) -> dano.Motion:
    x, _, theta, *_ = impacts.before[i]
    height = float(arms(theta, SEMI_AXES)[1]) + kind.gap
    pair = np.stack([impacts.before[i, 3:], impacts.after[i, 3:]])
    unknown = [np.nan] * 3
    return dano.Motion.create(
        [0.0, kind.n_steps * kind.timestep],
        "plate",
        position=[[x, 0, height], unknown],
        orientation=[[np.cos(theta / 2), 0, np.sin(theta / 2), 0], [np.nan] * 4],
        velocity=np.stack([pair[:, 0], np.zeros(2), pair[:, 1]], axis=-1),
        omega=np.stack([np.zeros(2), pair[:, 2], np.zeros(2)], axis=-1),
        # As a simulation has them. Else the first would be taken back by half a step of the impact's slope.
        lag=0.5 * kind.timestep,
    )


def _paired(one: np.ndarray, other: np.ndarray) -> tuple[float, str]:
    """Median of one less that of the other, and its standard error in words: the same are drawn of both."""
    drawn = np.random.default_rng(0).integers(0, len(one), (1000, len(one)))
    spread = np.std(np.median(one[drawn], axis=1) - np.median(other[drawn], axis=1))
    return float(np.median(one) - np.median(other)), f"± {spread:.2g}, paired"


def _errors(
    group: str, held: Impacts, after: np.ndarray, *, name: str = "", targets=(None, None), note: str = ""
) -> list[Row]:
    off = after - held.after[:, 3:]
    of_velocity, of_spin = np.linalg.norm(off[:, :2], axis=1), np.abs(off[:, 2])
    label = f"{name}: " if name else ""
    found = []
    pairs = ((VELOCITY, of_velocity, "m/s"), (SPIN, of_spin, "rad/s"))
    for (words, values, unit), target in zip(pairs, targets, strict=True):
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
        said = f"± {_median_error(values):.2g}" + (f"; {note}" if note else "")
        found.append(Row(group, label + words, middle, unit, target, quartiles=(low, high), note=said))
    return found


def _median_error(values: np.ndarray) -> float:
    """Standard error of a median, over resampled values."""
    drawn = np.random.default_rng(0).integers(0, len(values), (1000, len(values)))
    return float(np.std(np.median(values[drawn], axis=1)))


def _between_parts(group: str, fitted: Impacts, whole: dano.Identification) -> list[Row]:
    """How constants of disjoint parts of the half scatter, in the standard errors that they state."""
    parts = [identify(fitted.some(np.arange(k, len(fitted), PARTS_OF_HALF))) for k in range(PARTS_OF_HALF)]
    found = []
    for name in PARAMETERS:
        inside = sum(p.interval(name)[0] <= whole.values[name] <= p.interval(name)[1] for p in parts)
        values = [float(p.values[name]) for p in parts]
        note = f"95 % intervals of parts that hold the value of all: {inside} of {len(parts)}"
        stated = float(np.mean([p.standard_errors[name] for p in parts]))
        spread = float(np.std(values, ddof=1)) / stated
        found.append(Row(group, f"{name}: scatter between six parts", spread, "σ", note=note))
    return found


def _others(fitted: Impacts, held: Impacts) -> list[Row]:
    """The laws of the file, and laws of two constants with either sign, tuned on the same half."""
    group = "Impacts of an ellipse: others"
    found = []
    for k, law in enumerate(SIX_LAWS):
        found += _errors(group, held, held.published[:, k], name=law, note="as the file has it")
    file = (_file_arms(fitted), _file_arms(held))
    after, note, _ = _tuned(lambda v, arm, x: newton(v, arm, GYRATION, *x), fitted, held, *file)
    return [*found, *_errors(group, held, after, name="two constants, Jacobian of the file", note=note)]


# Laws at a point, from the velocity before, the arms and the constants x: restitution, friction, and a third
# one.
Law = Callable[[np.ndarray, tuple, np.ndarray], np.ndarray]
FURTHER_LAWS: dict[str, Law] = {
    "Poisson, and slow slip turns round": lambda v, arm, x: following_slip(
        v, arm, GYRATION, x[0], x[1], rebound=x[2]
    ),
    "Poisson, and less restitution the faster the slip": lambda v, arm, x: following_slip(
        v, arm, GYRATION, _falling(x, np.abs(at_contact(v, arm)[1])), x[1]
    ),
    "Poisson, and less restitution the faster the centre along the floor": lambda v, arm, x: following_slip(
        v, arm, GYRATION, _falling(x, np.abs(v[:, 0])), x[1]
    ),
}
OF_A_STEP = "AP Newton"
"""The law whose impacts are those of dano within a step."""


def _falling(x: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Restitution that falls with a speed, by x[2] for a metre per second, and is x[0] at .6 m/s."""
    return np.clip(x[0] - x[2] * (speed - 0.6), 0.05, 1.0)


def _laws(fitted: Impacts, held: Impacts) -> list[Row]:
    """The six laws with the right sign, and more, in closed form, tuned on the same half."""
    group = "Impacts of an ellipse: laws at a point, sign put right"
    pair = [arms(x.before[:, 2], SEMI_AXES) for x in (fitted, held)]

    def of(law: Callable[..., np.ndarray]) -> Law:
        return lambda v, arm, x: law(v, arm, GYRATION, *x)

    laws = {name: (of(law), None) for name, law in SIX_LAWS.items()}
    laws["friction follows the slip, Newton"] = (of(functools.partial(following_slip, ends="newton")), None)
    laws |= {name: (law, 0.1) for name, law in FURTHER_LAWS.items()}
    found, off = [], {}
    for name, (law, third) in laws.items():
        after, note, misfit = _tuned(law, fitted, held, *pair, third=third)
        off[name] = np.linalg.norm((after - held.after[:, 3:])[:, :2], axis=1)
        found += _errors(group, held, after, name=name, note=f"{note}; misfit of the held {misfit:.3f}")
    group = "Impacts of an ellipse: velocity error less that of " + OF_A_STEP
    for name in off:
        if name != OF_A_STEP:
            less, error = _paired(off[name], off[OF_A_STEP])
            found.append(Row(group, name, less, "m/s", note=error))
    return found


def _tuned(
    law: Law, fitted: Impacts, held: Impacts, arm: tuple, of_held: tuple, *, third: float | None = None
) -> tuple[np.ndarray, str, float]:
    """Velocities after the held impacts, the constants in words, and the misfit of the held."""
    scale = np.array([NOISE["velocity"]] * 2 + [NOISE["omega"]])

    def misfit(after: np.ndarray, impacts: Impacts) -> float:
        size = np.linalg.norm((after - impacts.after[:, 3:]) / scale, axis=1)
        return float(np.mean(np.where(size < HUBER, size**2 / 2, HUBER * (size - HUBER / 2))))

    first = [0.58, 0.19] + ([] if third is None else [third])
    best = minimize(
        lambda x: misfit(law(fitted.before[:, 3:], arm, x), fitted),
        first,
        method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-6},
    ).x
    after = law(held.before[:, 3:], of_held, best)
    note = f"restitution {best[0]:.3f}, friction {best[1]:.3f}"
    note += "" if third is None else f", third constant {best[2]:.3f}"
    return after, note + " of the same half", misfit(after, held)


def _file_arms(impacts: Impacts) -> tuple[np.ndarray, np.ndarray]:
    """Arms with which the file's Jacobian stands in the equations of `_points`."""
    return -impacts.normal[:, 2], -impacts.tangent[:, 2]


def _repeats(held: Impacts, constants: dict[str, float]) -> list[Row]:
    """How much two impacts of nearly the same state differ: no law of that state can know it."""
    group = "Impacts of an ellipse: repeats"
    theta, velocity = held.before[:, 2], held.before[:, 3:]
    state = np.column_stack([np.cos(2 * theta), np.sin(2 * theta), velocity]) / ALIKE
    pairs = cKDTree(state).query_pairs(1.0, output_type="ndarray")
    if len(pairs) < 5:
        return [skipped(group, VELOCITY, f"{len(pairs)} pairs are alike")]
    # What the law says takes away that the two states are not quite the same.
    left = (
        simulated(held, friction=constants["friction"], restitution=constants["restitution"])
        - held.after[:, 3:]
    )
    apart = (left[pairs[:, 0]] - left[pairs[:, 1]]) / np.sqrt(2.0)
    note = f"{len(pairs)} pairs; over √2, as the error of a law that knows all but what differs"
    of_velocity = float(np.median(np.linalg.norm(apart[:, :2], axis=1)))
    return [
        Row(group, VELOCITY, of_velocity, "m/s", note=note),
        Row(group, SPIN, float(np.median(np.abs(apart[:, 2]))), "rad/s"),
    ]


def _jacobian(held: Impacts) -> list[Row]:
    """Which sign of the Jacobian the measured changes of velocity have, and what moments it leaves.

    Without any law: k² dω = −a P_n − s h P_t for impulses at the lowest point, with s = 1 where θ turns z
    into x and s = −1 where it turns x into z, as in the file.
    """
    group = "Impacts of an ellipse: which way θ turns"
    along, below = arms(held.before[:, 2], SEMI_AXES)
    change = held.after[:, 3:] - held.before[:, 3:]
    table = np.column_stack([-along * change[:, 1], -below * change[:, 0]]) / GYRATION**2
    (normal, tangent), *_ = np.linalg.lstsq(table, change[:, 2])
    right = moment_left(held.before[:, 3:], held.after[:, 3:], (along, below), GYRATION)
    wrong = moment_left(held.before[:, 3:], held.after[:, 3:], _file_arms(held), GYRATION)
    slip = np.abs(held.after[:, 3] - below * held.after[:, 5])
    other = np.abs(held.after[:, 3] + below * held.after[:, 5])
    return [
        Row(
            group, "share of the normal impulse's moment in the spin", normal, "", note="1 where all is right"
        ),
        Row(
            group, "share of friction's moment in the spin", tangent, "", note="−1 were the file's sign right"
        ),
        Row(group, "slip after, median", float(np.median(slip)), "m/s"),
        Row(group, "slip after, by the file's Jacobian", float(np.median(other)), "m/s"),
        Row(
            group,
            "how far from the lowest point the impulse passes, median",
            1e3 * float(np.median(np.abs(right))),
            "mm",
            note="half of the ellipse's width is 25 to 35 mm",
        ),
        Row(group, "the same by the file's Jacobian", 1e3 * float(np.median(np.abs(wrong))), "mm"),
    ]


def picture(source: Source, folder: Path) -> Path:
    """Velocities after the held impacts, measured and predicted: dano beside a law of the file."""
    from benchmarks.real._pictures import scatter

    fitted, held = source.split("impacts.npz", Impacts.load)
    fit = identify(fitted.some(np.arange(120)))
    friction, restitution = (float(fit.values[name]) for name in PARAMETERS)
    after = simulated(held, friction=friction, restitution=restitution)
    seen = held.after[:, 3:]
    panels = [
        (f"{words} [{unit}]", seen[:, k], held.published[:, 4, k], after[:, k])
        for k, (words, unit) in enumerate(
            (("speed along the floor", "m/s"), ("rise", "m/s"), ("spin", "rad/s"))
        )
    ]
    return scatter(folder / "real_impacts.png", panels, ("Wang and Mason, as the data set has it", "dano"))
