"""What `identify` may be told: parameters, how the search runs, what is estimated besides, and the noise.

A parameter says which leaves of a scene are unknown, within which bounds, and in which coordinates.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano import checks
from dano.engine import AbstractEngine
from dano.identification.motions import Motion, QUANTITIES
from dano.maths import checked_numbers, Numbers
from dano.names import did_you_mean
from dano.scene import Scene

_OF_BODIES = ("mass_scale", "com_offset", "inertia", "mass", "com")
"""Properties of bodies that a parameter may be written as."""


@dataclasses.dataclass(frozen=True, eq=False)
class Parameter:
    """An unknown: leaves of a scene that take one value, and where that value may lie.

    Attributes:
        name: What results call it.
        where: From the scene to a leaf, or to a list of leaves that share the value, e.g.
            ``lambda s: s.contact("bunny", "floor").sliding_friction``.
            For what is not a leaf see `apply`.
        lower: Smallest value (a number, or an array of the leaf's shape).
        upper: Largest value.
        start: Where to begin; default the scene's own value, moved into the bounds.
        coordinates: What the solver steps in: the "value" itself; its logarithm ("log"), for positive
            quantities whose order of magnitude is unknown; or "inertia": the log-Cholesky factor of the
            matrix Σ = ½ tr(J) I − J of second moments, so that every value is the inertia tensor of some
            mass distribution. Default: "inertia" for leaves of shape (3, 3), "value" for others.
        of: "scene", or "controls" for leaves of the controls given to `identify`.
        apply: Instead of `where`, from the scene and the value to the scene that has it, for what is not a
            leaf itself, e.g. the half side of a box whose corners follow; needs `start`, which gives the
            shape.
    """

    name: str
    where: Callable[[Any], Any] | None = None
    lower: Numbers = -np.inf
    upper: Numbers = np.inf
    start: Numbers | None = None
    coordinates: str | None = None
    of: str = "scene"
    apply: Callable[[Any, Array], Any] | None = None

    def __post_init__(self) -> None:
        """Check what can be checked without a scene.

        Raises:
            ValueError: If the name is empty, both or none of `where` and `apply` are given, a number is not
                one, bounds cross, or a word is unknown.
        """
        what = f"of parameter {checks.checked_text('name', self.name)!r}"
        if (self.where is None) == (self.apply is None):
            which = "none" if self.where is None else "both"
            raise ValueError(f"parameter {self.name!r} must have either where or apply, got {which}")
        checks.checked_function("where", self.where if self.where is not None else self.apply)
        checks.checked_choice("of", self.of, ("scene", "controls"))
        if self.coordinates is not None:
            checks.checked_choice("coordinates", self.coordinates, ("value", "log", "inertia"))
        for name in ("lower", "upper", "start"):
            value = getattr(self, name)
            if value is not None and np.any(np.isnan(checked_numbers(f"{name} {what}", value))):
                raise ValueError(f"{name} {what} must not be NaN")
        lower, upper = (checked_numbers(name, getattr(self, name)) for name in ("lower", "upper"))
        if lower.shape == upper.shape and np.any(lower > upper):
            raise ValueError(f"lower {what} must be ≤ upper, got {self.lower} and {self.upper}")
        if self.start is None or self.coordinates == "inertia":
            return
        start = checked_numbers("start", self.start)
        if start.shape == lower.shape == upper.shape and not np.all((lower <= start) & (start <= upper)):
            raise ValueError(f"start {what} must lie between {self.lower} and {self.upper}, got {self.start}")


def parameter_of(text: str, scene: Scene) -> Parameter:
    """A parameter from PATH:LOWER:UPPER[:START], PATH being BODY.PROPERTY or BODY,BODY.PROPERTY.

    Args:
        text: Such as "soap,table.sliding_friction:0:1" or "soap.mass_scale:0.2:5:1".
        scene: That it is of.

    Raises:
        ValueError: If the text is not of that form or names nothing in the scene.
    """
    checks.checked_text("parameter", text)
    form = "BODY.PROPERTY:LOWER:UPPER[:START] or BODY,BODY.PROPERTY:LOWER:UPPER[:START]"
    path, *numbers = text.split(":")
    owner, _, name = path.rpartition(".")
    try:
        bounds = [float(number) for number in numbers]
    except ValueError as error:
        raise ValueError(f"parameter must be written {form}, got {text!r}") from error
    if not owner or len(bounds) not in (0, 2, 3):
        raise ValueError(f"parameter must be written {form}, got {text!r}")
    lower, upper = bounds[:2] or (-np.inf, np.inf)
    start = bounds[2] if len(bounds) == 3 else None
    bodies = [body.name for body in scene.bodies]
    for body in map(str.strip, owner.split(",")):
        if body not in bodies:
            raise ValueError(
                f"parameter {text!r} must name bodies of the scene {bodies}, got {body!r}"
                + did_you_mean(body, bodies)
            )
    if "," in owner:
        a, b = (part.strip() for part in owner.split(",", 1))
        place = scene.contact_index(a, b)
        valid = scene.contacts[place].law.reads
        where = lambda s: getattr(s.contacts[place].params, name)  # noqa: E731
    else:
        valid = _OF_BODIES
        place = scene.index(owner)
        where = lambda s: getattr(s.bodies[place], name)  # noqa: E731
    if name not in valid:
        raise ValueError(
            f"property in parameter {text!r} must be one of {', '.join(valid)}, got {name!r}"
            + did_you_mean(name, valid)
        )
    return Parameter(path, where, lower, upper, start=start)


class Selection(NamedTuple):
    """Static part of a parameter, checked: enough to read it from and write it to a scene."""

    name: str
    put: Callable[[Any, Array], Any]
    of: str
    coordinates: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return 6 if self.coordinates == "inertia" else int(np.prod(self.shape))

    def value(self, x: Float[Array, " k"]) -> Array:
        """The value at coordinates x."""
        if self.coordinates == "inertia":
            return _inertia(x)
        flat = jnp.exp(x) if self.coordinates == "log" else x
        return flat.reshape(self.shape)

    @property
    def labels(self) -> list[str]:
        """Names of the coordinates."""
        if self.size == 1:
            return [self.name]
        if self.coordinates == "inertia":
            return [f"{self.name}[{axes}]" for axes in ("xx", "yy", "zz", "xy", "xz", "yz")]
        return [f"{self.name}[{', '.join(map(str, index))}]" for index in np.ndindex(*self.shape)]


@dataclasses.dataclass(frozen=True)
class _Leaves:
    """Puts a value into leaves; equal to others of the same leaves, so that programs are compiled once.

    Leaves are told by their places in the flattened tree: functions that pick them are never equal.
    """

    places: tuple[int, ...]

    def __call__(self, tree: Any, value: Array) -> Any:
        """The tree with the value in all of its leaves."""
        leaves, structure = jax.tree.flatten(tree)
        for place in self.places:
            leaves[place] = value.astype(leaves[place].dtype)
        return jax.tree.unflatten(structure, leaves)


class _LeafPlace:
    """Stands for a leaf of a tree."""

    def __init__(self, index: int):
        self.index = index


class Space(NamedTuple):
    """The solver's coordinates of all parameters, one after the other."""

    selections: tuple[Selection, ...]
    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def labels(self) -> list[str]:
        """Names of the coordinates."""
        return [label for selection in self.selections for label in selection.labels]


def space_of(scene: Any, controls: Any, parameters: Sequence[Parameter]) -> Space:
    """Check parameters against a scene.

    Raises:
        ValueError: If there is none, two have one name, one picks no array, its leaves differ in shape, its
            bounds cross or exclude its start, or its coordinates do not fit.
    """
    if not parameters:
        raise ValueError("parameters must hold at least one Parameter, got none")
    names = [p.name for p in parameters]
    if len(set(names)) < len(names):
        raise ValueError(f"parameters must have different names, got {names}")
    parts = [_checked(p, controls if p.of == "controls" else scene) for p in parameters]
    selections, *columns = zip(*parts, strict=True)
    return Space(selections, *(np.concatenate(column) for column in columns))


def _checked(p: Parameter, home: Any) -> tuple[Selection, np.ndarray, np.ndarray, np.ndarray]:
    what = f"parameter {p.name!r}"
    if home is None:
        raise ValueError(f"{what} is one of the controls, but no controls are given")
    current, put = _derived(p, what, home) if p.where is None else _picked(p, what, home)
    shape = current.shape
    coordinates = p.coordinates or ("inertia" if shape == (3, 3) else "value")
    selection = Selection(p.name, put, p.of, coordinates, shape)
    value = np.asarray(current if p.start is None else p.start, dtype=float)
    if coordinates == "inertia":
        return selection, *_inertia_box(what, p, shape, value)
    lower, upper = (_bound(what, key, getattr(p, key), shape) for key in ("lower", "upper"))
    if np.any(lower > upper):
        raise ValueError(f"lower of {what} must be ≤ upper, got {p.lower} and {p.upper}")
    if p.start is None:
        value = np.clip(value, lower, upper)
    elif value.shape not in (shape, ()):
        raise ValueError(f"start of {what} must have shape {shape}, got {value.shape}")
    value = np.broadcast_to(value, shape)
    if not np.all((lower <= value) & (value <= upper)):
        raise ValueError(
            f"start of {what} must lie between {lower.tolist()} and {upper.tolist()}, got {value.tolist()}"
        )
    if coordinates == "log":
        if np.any(value <= 0) or np.any(upper <= 0):
            raise ValueError(f"{what} must be > 0 to have a logarithm, got start {value.tolist()}")
        with np.errstate(divide="ignore"):
            lower, upper = np.log(np.maximum(lower, 0)), np.log(upper)
        value = np.log(value)
    return selection, np.ravel(value), np.ravel(lower), np.ravel(upper)


def _derived(p: Parameter, what: str, home: Any) -> tuple[np.ndarray, Callable[[Any, Array], Any]]:
    """Start and setter of a parameter with `apply`."""
    if p.start is None:
        raise ValueError(f"{what} has no leaf to begin at: give its start")
    assert p.apply is not None
    start = np.asarray(p.start, dtype=float)
    tree = p.apply(home, jnp.asarray(start))
    if jax.tree_util.tree_structure(tree) != jax.tree_util.tree_structure(home):
        raise ValueError(
            f"apply in {what} must return the {p.of} with other values, got {type(tree).__name__}"
        )
    return start, p.apply


def _picked(p: Parameter, what: str, home: Any) -> tuple[np.ndarray, Callable[[Any, Array], Any]]:
    """Current value and setter of a parameter with `where`."""
    where = p.where
    assert where is not None
    not_whole = f"where in {what} must pick whole leaves of the {p.of}, not parts or copies of them"
    try:
        leaves = _leaves(where, home)
    except (AttributeError, TypeError, KeyError, IndexError) as error:
        raise ValueError(f"where in {what} must pick leaves of the {p.of}: {error}") from error
    except ValueError as error:
        raise ValueError(f"where in {what}: {error}") from error
    for leaf in leaves:
        if not eqx.is_inexact_array(leaf):
            raise ValueError(
                f"where in {what} must pick floating-point arrays of the {p.of}, got {type(leaf).__name__}"
                + (": its law does not use it" if leaf is None else "")
            )
    structure = jax.tree.structure(home)
    try:
        picked = _leaves(where, jax.tree.unflatten(structure, map(_LeafPlace, range(structure.num_leaves))))
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(not_whole) from error
    places = tuple(each.index for each in picked if isinstance(each, _LeafPlace))
    if len(places) < len(leaves):
        raise ValueError(not_whole)
    if len(set(places)) < len(places):
        raise ValueError(f"where in {what} must pick each leaf once")
    shapes = {leaf.shape for leaf in leaves}
    if len(shapes) != 1:
        raise ValueError(f"leaves of {what} must have one shape, got {sorted(shapes)}")
    return np.asarray(leaves[0]), _Leaves(places)


def _bound(what: str, key: str, bound: Numbers, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(bound, dtype=float)
    if array.shape not in ((), shape) or np.any(np.isnan(array)):
        raise ValueError(f"{key} of {what} must be a number or have shape {shape}, got {bound}")
    return np.broadcast_to(array, shape)


def _inertia_box(what: str, p: Parameter, shape: tuple[int, ...], value: np.ndarray):
    if shape != (3, 3) or value.shape != (3, 3):
        raise ValueError(f"{what} must be a (3, 3) inertia tensor, got shape {shape}, start {value.shape}")
    if np.any(np.isfinite(np.asarray(p.lower))) or np.any(np.isfinite(np.asarray(p.upper))):
        raise ValueError(f"{what} is an inertia tensor, which takes no bounds: leave lower and upper out")
    try:
        start = _log_cholesky(value)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"start of {what} must be the inertia of some body, got principal values "
            f"{np.linalg.eigvalsh(value).tolist()}"
        ) from error
    infinite = np.full(6, np.inf)
    return start, -infinite, infinite


def _leaves(where: Callable[[Any], Any], tree: Any) -> list[Any]:
    found = where(tree)
    return list(found) if isinstance(found, (list, tuple)) else [found]


def with_values(selections: Sequence[Selection], home: str, tree: Any, x: Float[Array, " p"]) -> Any:
    """A scene, or controls, whose leaves hold the values at coordinates x."""
    offset = 0
    for selection in selections:
        part = x[offset : offset + selection.size]
        offset += selection.size
        if selection.of == home:
            tree = selection.put(tree, selection.value(part))
    return tree


def values_at(
    selections: Sequence[Selection], x: np.ndarray, covariance: np.ndarray
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values by name, and their standard errors to first order, from coordinates and their covariance."""
    values, errors = {}, {}
    offset = 0
    for selection in selections:
        part = slice(offset, offset + selection.size)
        offset += selection.size
        at = jnp.asarray(x[part])
        slope = np.asarray(jax.jacfwd(selection.value)(at)).reshape(-1, selection.size)
        with np.errstate(invalid="ignore"):
            variance = np.einsum("ia,ab,ib->i", slope, covariance[part, part], slope)
        error = np.sqrt(np.maximum(variance, 0)).reshape(selection.shape)
        value = np.asarray(selection.value(at), dtype=float)
        values[selection.name] = float(value) if value.shape == () else value
        errors[selection.name] = float(error) if error.shape == () else error
    return values, errors


def masses_of(
    selections: Sequence[Selection], scene: Scene, values: dict[str, Any], errors: dict[str, Any]
) -> dict[str, tuple[float, float]]:
    """Mass [kg] and its standard error of the bodies whose `mass_scale` is a parameter, by name."""
    tree = jax.tree.structure(scene)
    numbered = jax.tree.unflatten(tree, range(tree.num_leaves))
    found = {}
    for selection in selections:
        if not isinstance(selection.put, _Leaves) or selection.of != "scene":
            continue
        for body, place in zip(scene.bodies, numbered.bodies, strict=True):
            if place.mass_scale in selection.put.places:
                scale, error = values[selection.name], errors[selection.name]
                found[body.name] = float(body.mass) * scale, float(body.mass) * error
    return found


def _inertia(x: Float[Array, "6"]) -> Float[Array, "3 3"]:
    zero = jnp.zeros_like(x[0])
    factor = jnp.stack(
        [
            jnp.stack([jnp.exp(x[0]), zero, zero]),
            jnp.stack([x[3], jnp.exp(x[1]), zero]),
            jnp.stack([x[4], x[5], jnp.exp(x[2])]),
        ]
    )
    second = factor @ factor.T
    return jnp.trace(second) * jnp.eye(3, dtype=x.dtype) - second


def _log_cholesky(inertia: np.ndarray) -> np.ndarray:
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    factor = np.linalg.cholesky(second)
    return np.array([*np.log(np.diag(factor)), factor[1, 0], factor[2, 0], factor[2, 1]])


_MOST_STARTS = 10_000
"""More starts than that would each cost several simulations of all windows: hours of work."""

_JACOBIANS = ("auto", "forward", "reverse")

INDEPENDENT = ("numbers", "windows", "motions")

_NOISE = (*QUANTITIES, "q")

_INITIAL = {"given": (), "velocities": ("velocity", "omega"), "states": tuple(QUANTITIES)}


@dataclass(frozen=True)
class IdentifyOptions:
    """How a search for parameters runs.

    Attributes:
        window: Frames of the windows that motions are cut into (multiple shooting); None: no cuts.
        continuity: Allowed gap between windows, as multiple of `noise`, or a falling sequence of it, searched
            with one after the other. Needs `window`, and all of the initial states to be estimated
            (`initial="states"`). None: any gap.
        huber: Length of a residual, in standard deviations, from which it counts linearly; None: never.
        independent: Between what errors are independent: "numbers" (all that were observed), "windows" or
            "motions", or a label for each motion: those of one label share errors, as pieces of one recording
            do. Within these they may then be anything, such as those of a law that is a little wrong, and
            standard errors come from how far these pull the parameters apart.
        smooth: Whether to go on by slopes over visible steps where the loss is rough: to the minimum of its
            trend, with standard errors that hold the ripples.
        starts: Points to start from: the scene's values, and others in the bounds. None: one, of one or two
            parameters with bounds the best of 16 all over these, else the scene's values.
        seed: Of everything random.
        max_iterations: Steps of each search.
        tolerance: Stop when the predicted move of the parameters is below this, in standard errors.
        jacobian: "forward" costs one rollout per unknown, "reverse" several per observed number, or "auto".
        batch: Windows that a device simulates at once; None: one on a CPU, many on a GPU.
        checkpoint: File (.npz) that a long search is kept in while it runs, and when interrupted; None: none.
        resume: Go on from `checkpoint` if it exists; the result is as if the search had never stopped.
    """

    window: int | None = None
    continuity: float | Sequence[float] | None = None
    huber: float | None = None
    independent: str | Sequence[str] = "numbers"
    smooth: bool = True
    starts: int | None = None
    seed: int = 0
    max_iterations: int = 100
    tolerance: float = 0.1
    jacobian: str = "auto"
    batch: int | None = None
    checkpoint: str | os.PathLike[str] | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        """Check what can be checked without a scene and motions.

        Raises:
            ValueError: If one is out of range, or does not fit the others.
        """
        if self.window is not None:
            checks.checked_count("window", self.window, least=2)
        if self.gaps and self.window is None:
            raise ValueError(f"continuity needs window, got continuity {self.continuity} and window None")
        if self.huber is not None:
            checks.checked_number("huber", self.huber, above=0)
        if isinstance(self.independent, str):
            checks.checked_choice("independent", self.independent, INDEPENDENT)
        else:
            checks.checked_items("independent", self.independent, str)
        if self.independent == "windows" and self.gaps:
            raise ValueError(
                "independent='windows' excludes continuity: windows that must meet are one motion"
            )
        if self.starts is not None:
            checks.checked_count("starts", self.starts, most=_MOST_STARTS)
        checks.checked_count("seed", self.seed, least=0)
        checks.checked_count("max_iterations", self.max_iterations)
        checks.checked_number("tolerance", self.tolerance, above=0)
        checks.checked_choice("jacobian", self.jacobian, _JACOBIANS)
        if self.batch is not None:
            checks.checked_count("batch", self.batch)
        if self.checkpoint is None:
            if self.resume:
                raise ValueError("resume needs a checkpoint to go on from, got checkpoint None")
        elif checks.checked_path("checkpoint", self.checkpoint).suffix.lower() != ".npz":
            raise ValueError(f"checkpoint must end in .npz, got {self.checkpoint}")

    @property
    def gaps(self) -> tuple[float, ...]:
        """Allowed gaps, searched with one after the other, in standard deviations; empty: any gap."""
        if self.continuity is None:
            return ()
        gaps = np.atleast_1d(checked_numbers("continuity", self.continuity))
        positive = np.all(np.isfinite(gaps) & (gaps > 0))
        if gaps.ndim > 1 or not positive or np.any(np.diff(gaps) >= 0):
            raise ValueError(
                "continuity must be finite and > 0, and a sequence of it must fall, got"
                f" {checks.shown(self.continuity)}"
            )
        return tuple(gaps.tolist())


@dataclass(frozen=True)
class Setup:
    """Arguments of `identify`, checked, that do not depend on the motions."""

    space: Space  # The unknowns
    scene: Scene  # The scene
    controls: Any  # As they were given
    initial: tuple[str, ...]  # Quantities that are estimated of the state in which each window begins
    noise: dict[str, float]  # Standard deviation of each quantity that counts
    options: IdentifyOptions  # How the search runs
    engine: AbstractEngine  # What simulates


def estimated(initial: str | Sequence[str] | None, motions: Sequence[Motion]) -> tuple[str, ...]:
    """Quantities of the initial states that are estimated, by the argument `initial` of `identify`.

    Raises:
        ValueError: If it is not one of the known words, or lists something else than quantities.
    """
    if initial is None and any(m.q is not None for m in motions):
        initial = "states"
    if initial is None:
        first = [np.concatenate([m.velocity, m.omega], axis=-1) for m in motions]
        initial = "given" if all(np.isfinite(v).all() for v in first) else "velocities"
    if isinstance(initial, str):
        return _INITIAL[checks.checked_choice("initial", initial, list(_INITIAL))]
    initial = checks.checked_items("initial", initial, str)
    if wrong := [key for key in initial if key not in QUANTITIES]:
        raise ValueError(f"initial must list some of {list(QUANTITIES)}, got {wrong[0]!r}")
    return tuple(key for key in QUANTITIES if key in initial)


def deviations(
    scene: Scene, motions: Sequence[Motion], noise: Mapping[str, float] | None
) -> dict[str, float]:
    """Standard deviations by quantity, by the argument `noise` of `identify`.

    Raises:
        ValueError: If one is not positive, there is none, or joint coordinates were observed and have none.
    """
    joints = any(m.q is not None for m in motions)
    if noise is None and all(m.q is not None for m in motions):
        return {"q": 1e-3}
    if noise is None:
        poses = _of_poses(scene, motions)
        return {**poses, "q": 1e-3} if joints else poses
    checks.checked_kind("noise", noise, Mapping, hint="; such as {'position': 0.001} [m]")
    for key, value in noise.items():
        if key not in _NOISE:
            raise ValueError(f"noise must be given for some of {list(_NOISE)}, got {key!r}")
        checks.checked_number(f"noise of {key}", value, above=0)
    if not noise:
        raise ValueError(f"noise must be given for at least one of {list(_NOISE)}, got none")
    if joints and "q" not in noise:
        raise ValueError(
            f"noise must be given for q [rad or m] where joint coordinates were observed, got {list(noise)}: "
            "poses follow from them and do not count"
        )
    return dict(noise)


def start_deviations(
    scene: Scene, motions: Sequence[Motion], noise: Mapping[str, float], span: float
) -> list[float]:
    """Standard deviations of the four quantities of an initial state, in their order.

    Velocities are as poses a time apart tell them, or better. What is estimated and has no noise, such as
    orientations of a log that holds positions alone, has the usual one.

    Args:
        scene: The scene.
        motions: What was observed.
        noise: Standard deviations of the quantities that count.
        span: The time [s].
    """
    found = {**dict.fromkeys(QUANTITIES, np.inf), **_of_poses(scene, motions), **noise}
    if "q" in noise:
        found |= {key: min(found[key], noise["q"]) for key in ("position", "orientation")}
    for slow, fast in (("position", "velocity"), ("orientation", "omega")):
        found[fast] = min(found[fast], found[slow] / span)
    return [found[key] for key in QUANTITIES]


def _of_poses(scene: Scene, motions: Sequence[Motion]) -> dict[str, float]:
    """Standard deviations of poses where none are stated."""
    sizes = [scene.body(name).size for m in motions for name in m.names if name in scene.names]
    finite = [size for size in sizes if np.isfinite(size)] or [1.0]
    # A thousandth of the size, seen at half the size from the middle.
    return {"position": 1e-3 * float(np.mean(finite)), "orientation": 2e-3}
