"""What shall be done, with which forces, and what it may cost."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano import checks, maths
from dano.names import did_you_mean
from dano.scene import Control, Scene, State

KINDS = {"force": 3, "torque": 3, "effort": 1, "command": 1}
"""What an actuator can be, and how many numbers it has."""
QUANTITIES = {"position": 3, "orientation": 4, "velocity": 3, "omega": 3, "q": 1, "v": 1}
"""What a goal or a limit can be about, and how many numbers that takes."""
_AXES = "xyz"


class Actuator(eqx.Module):
    """A force, a torque, a joint's effort or its motor's command that the plan may choose."""

    # Name of the body; for an effort or a command the one that hangs on the joint.
    body: str = eqx.field(static=True)
    # "force" at the centre of mass [N, W], "torque" [N m, W], "effort" of a joint [N m or N], or "command" of
    # its motor, see `dano.Motor`.
    kind: str = eqx.field(static=True)
    # Which components of a force or a torque it has, e.g. "xy" (static).
    axes: str = eqx.field(static=True)
    lower: Float[Array, " m"]  # Least values, shape (number of axes,)
    upper: Float[Array, " m"]  # Largest values
    cost: Float[Array, ""]  # Price of its squares [1/(N² s)] or [1/(N² m² s)]

    def __init__(
        self,
        body: str,
        kind: str = "force",
        *,
        limit: maths.Numbers | None = None,
        lower: maths.Numbers | None = None,
        upper: maths.Numbers | None = None,
        axes: str = _AXES,
        cost: maths.Numbers = 1e-4,
    ):
        """See the class.

        Args:
            body: Name of the body.
            kind: "force", "torque", "effort" or "command".
            limit: Bound of the magnitude of every component; instead of `lower` and `upper`.
            lower: Least value, one number or one per axis.
            upper: Largest value.
            axes: Components in use, letters of "xyz"; unused for an effort or a command.
            cost: Price of its squares.

        Raises:
            ValueError: If the kind or an axis is unknown, the bounds are missing, not finite or crossed, or
                the cost is negative.
        """
        checks.checked_text("body", body)
        checks.checked_choice(f"kind of the actuator of {body!r}", kind, list(KINDS))
        self.body, self.kind = body, kind
        self.axes = "" if KINDS[kind] == 1 else _checked_axes(axes, f"the {kind} of {body!r}")
        what = f"of the {kind} of {body!r}"
        if limit is not None:
            if lower is not None or upper is not None:
                raise ValueError(f"limit {what} must stand alone, got lower or upper besides it")
            upper = maths.checked_numbers(f"limit {what}", limit)
            lower = -upper
            if not 1 <= upper.size <= max(1, len(self.axes)) or not np.all(np.isfinite(upper) & (upper > 0)):
                raise ValueError(
                    f"limit {what} must be finite and > 0, one number or one per axis, got"
                    f" {checks.shown(limit)}"
                )
        if lower is None or upper is None:
            raise ValueError(f"bounds {what} must be given: limit, or lower and upper")
        n = max(1, len(self.axes))
        self.lower = _spread(f"lower {what}", lower, n)
        self.upper = _spread(f"upper {what}", upper, n)
        if not maths.is_traced(self.lower, self.upper) and not np.all(np.asarray(self.lower < self.upper)):
            raise ValueError(
                f"lower {what} must be < upper, got {np.asarray(self.lower).tolist()} and "
                f"{np.asarray(self.upper).tolist()}: no control lies between them"
            )
        self.cost = maths.checked_array(f"cost {what}", cost, (), least=0.0)

    @property
    def size(self) -> int:
        """How many controls it has."""
        return max(1, len(self.axes))

    def places(self) -> np.ndarray:
        """Components of a force or torque that it has."""
        return np.array([_AXES.index(axis) for axis in self.axes])


class Goal(eqx.Module):
    """What one quantity of a body shall become.

    A goal costs ½ w |e|² per second on the way and ½ w_T |e|² at the end, and if it is required the plan
    must reach it: |e_i| ≤ within for each component. e is the difference to the value; for orientations the
    rotation vector [rad] from the goal to the body, in the goal's frame.
    """

    body: str = eqx.field(static=True)  # Name of the body; for q and v the one that hangs on the joint
    # "position" [m, W], "orientation", "velocity" [m/s, W], "omega" [rad/s, B], "q" or "v".
    quantity: str = eqx.field(static=True)
    value: Float[Array, " n"]  # What it shall become
    # Which components count, e.g. "xy" (static); for orientations components of e.
    axes: str = eqx.field(static=True)
    running: Float[Array, ""]  # w [1/(unit² s)]
    final: Float[Array, ""]  # w_T [1/unit²]
    required: bool = eqx.field(static=True)  # Whether the plan must reach it (static)
    within: Float[Array, ""]  # How near counts as reached [unit]

    def __init__(
        self,
        body: str,
        *,
        running: maths.Numbers = 0.0,
        final: maths.Numbers = 0.0,
        required: bool = True,
        within: maths.Numbers = 1e-3,
        axes: str = _AXES,
        **value: maths.Numbers,
    ):
        """A goal such as ``Goal("bunny", position=(1, 0, 0.3), within=0.01)``.

        Args:
            body: Name of the body.
            running: w.
            final: w_T.
            required: Whether it must be reached.
            within: How near counts as reached.
            axes: Which components count.
            **value: One of `position, orientation, velocity, omega, q, v`.

        Raises:
            ValueError: If not exactly one quantity is given, it is unknown, a shape is wrong, or a weight is
                negative or `within` not positive.
        """
        checks.checked_text("body", body)
        if len(value) != 1:
            raise ValueError(
                f"goal of {body!r} must have one of {', '.join(QUANTITIES)}, got {list(value) or 'none'}"
            )
        self.body, self.quantity = body, next(iter(value))
        self.value = _checked_value(self.quantity, value[self.quantity], f"of the goal of {body!r}")
        self.axes = _AXES if self.quantity in ("q", "v") else _checked_axes(axes, f"the goal of {body!r}")
        self.required = bool(required)
        for name, number in (("running", running), ("final", final), ("within", within)):
            bound = {"above": 0.0} if name == "within" else {"least": 0.0}
            setattr(self, name, maths.checked_array(f"{name} of the goal of {body!r}", number, (), **bound))

    @property
    def name(self) -> str:
        """What it is called in results."""
        return f"{self.quantity} of {self.body}"

    def error(self, scene: Scene, state: State, *, placed: bool = False) -> Float[Array, " p"]:
        """E at a state, shape (number of axes,).

        Args:
            scene: Of the state.
            state: Where to ask.
            placed: Whether poses of bodies on joints are known to be those of `state.q`, as they are in
                states that `Scene.filled` or a step returned. Derivatives by `q` are lost then.
        """
        filled = state if placed else _placed(scene, state, self.body, self.quantity)
        return _difference(scene, filled, self.body, self.quantity, self.value, self.axes)


class Limit(eqx.Module):
    """Bounds that a quantity of a body must keep at every step.

    Attributes:
        body: As in `Goal`.
        quantity: As in `Goal`, without "orientation".
        lower: Least values, shape (number of axes,); −∞ for none.
        upper: Largest values; ∞ for none.
        axes: As in `Goal`.
    """

    body: str = eqx.field(static=True)
    quantity: str = eqx.field(static=True)
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]
    axes: str = eqx.field(static=True)

    def __init__(
        self,
        body: str,
        quantity: str,
        *,
        lower: maths.Numbers = -np.inf,
        upper: maths.Numbers = np.inf,
        axes: str = _AXES,
    ):
        """See the class.

        Raises:
            ValueError: If the quantity is unknown, or bounds are NaN or crossed.
        """
        checks.checked_text("body", body)
        valid = [name for name in QUANTITIES if name != "orientation"]
        checks.checked_choice(f"quantity of the limit of {body!r}", quantity, valid)
        self.body, self.quantity = body, quantity
        self.axes = _AXES if QUANTITIES[quantity] == 1 else _checked_axes(axes, f"the limit of {body!r}")
        n = 1 if QUANTITIES[quantity] == 1 else len(self.axes)
        bounds = []
        for side, given in (("lower", lower), ("upper", upper)):
            bound = maths.checked_numbers(f"{side} of the limit of {body!r}", given)
            if bound.shape not in ((), (n,)) or np.any(np.isnan(bound)):
                raise ValueError(
                    f"{side} of the limit of {body!r} must be one number or {n}, not NaN, got"
                    f" {checks.shown(given)}"
                )
            bounds.append(bound)
        self.lower, self.upper = (jnp.asarray(np.broadcast_to(b, (n,))) for b in bounds)
        if not np.all(self.lower <= self.upper):
            raise ValueError(f"lower of the limit of {body!r} must be ≤ upper, got {lower} and {upper}")

    @property
    def name(self) -> str:
        """What it is called in results."""
        return f"limit of {self.quantity} of {self.body}"

    def excess(self, scene: Scene, state: State) -> Float[Array, " p"]:
        """How far beyond each finite bound a state is; negative inside."""
        n = QUANTITIES[self.quantity]
        filled, none = _placed(scene, state, self.body, self.quantity), jnp.zeros(n, self.lower.dtype)
        value = _difference(scene, filled, self.body, self.quantity, none, self.axes)
        # An infinite bound is not a condition; a finite number keeps derivatives finite.
        over = jnp.where(jnp.isfinite(self.upper), value - self.upper, -1.0)
        under = jnp.where(jnp.isfinite(self.lower), self.lower - value, -1.0)
        return jnp.concatenate([over, under])


class Task(eqx.Module):
    """What shall be done.

    Attributes:
        n_steps: Number of steps of the plan (static).
        actuators: What the plan chooses.
        goals: What shall become of the bodies.
        limits: What they must keep on the way.
    """

    n_steps: int = eqx.field(static=True)
    actuators: tuple[Actuator, ...]
    goals: tuple[Goal, ...]
    limits: tuple[Limit, ...] = ()

    def __init__(
        self,
        n_steps: int,
        actuators: Sequence[Actuator],
        goals: Sequence[Goal],
        limits: Sequence[Limit] = (),
    ):
        """See the class.

        Raises:
            ValueError: If there is no step, no actuator or no goal, or two actuators drive the same.
        """
        self.n_steps = checks.checked_count("n_steps", n_steps)
        self.actuators = checks.checked_items("actuators", actuators, Actuator)
        self.goals, self.limits = (
            checks.checked_items("goals", goals, Goal),
            checks.checked_items("limits", limits, Limit),
        )
        if not self.actuators or not self.goals:
            raise ValueError("task must have at least one actuator and one goal")
        driven = [(a.body, a.kind, axis) for a in self.actuators for axis in a.axes or "q"]
        for place in driven:
            if driven.count(place) > 1:
                raise ValueError(
                    f"actuators must drive different things, got the {place[1]} of {place[0]!r} twice"
                )

    def check(self, scene: Scene) -> None:
        """Raise a ValueError unless bodies and joints that the task names are those of a scene."""
        layout = scene.layout
        for part in (*self.actuators, *self.goals, *self.limits):
            kind = part.kind if isinstance(part, Actuator) else part.quantity
            if part.body not in scene.names:
                raise ValueError(
                    f"task must name bodies of the scene {list(scene.names)}, got {part.body!r}"
                    + did_you_mean(part.body, scene.names)
                )
            i = scene.index(part.body)
            joint = layout.joint_of(i)
            if kind in ("effort", "command", "q", "v") and (joint is None or layout.width(joint) != 1):
                raise ValueError(
                    f"{kind} of {part.body!r} must be that of a joint with one coordinate, got a body without"
                )
            if kind == "command" and joint is not None and scene.joints[joint].motor is None:
                raise ValueError(
                    f"command of {part.body!r} must be that of a joint with a motor, it has none"
                )
            if isinstance(part, Actuator) and i not in layout.moving:
                raise ValueError(f"actuator must drive a body that moves, got the fixed {part.body!r}")

    def bounds(self) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Least and largest controls, actuators after each other."""
        lower = jnp.concatenate([a.lower for a in self.actuators])
        return lower, jnp.concatenate([a.upper for a in self.actuators])

    def prices(self) -> Float[Array, " m"]:
        """Price of the square of every control."""
        return jnp.concatenate([jnp.broadcast_to(a.cost, (a.size,)) for a in self.actuators])

    def control(self, scene: Scene, u: Float[Array, " m"]) -> Control:
        """Forces, torques and efforts of controls [N, N m] of one step."""
        n = len(scene.bodies)
        force, torque = jnp.zeros((n, 3), u.dtype), jnp.zeros((n, 3), u.dtype)
        layout = scene.layout
        given = {"effort": jnp.zeros(layout.n_joints, u.dtype)} if layout.n_joints else {}
        if scene.driven:
            given["command"] = jnp.zeros(layout.n_joints, u.dtype)
        at = 0
        for actuator in self.actuators:
            values, i = u[at : at + actuator.size], scene.index(actuator.body)
            at += actuator.size
            if KINDS[actuator.kind] == 1:
                joint = layout.joint_of(i)
                assert joint is not None
                place = layout.coordinates[joint]
                given[actuator.kind] = given[actuator.kind].at[place].add(values[0])
            elif actuator.kind == "force":
                force = force.at[i, actuator.places()].add(values)
            else:
                torque = torque.at[i, actuator.places()].add(values)
        return Control(force, torque, **given)

    def controls(self, scene: Scene, u: Float[Array, "T m"]) -> Control:
        """`control` of every step."""
        return jax.vmap(lambda row: self.control(scene, row))(u)


def _placed(scene: Scene, state: State, body: str, quantity: str) -> State:
    """The state with poses of bodies on joints as its `q` says, where the quantity depends on them."""
    on_joint = scene.layout.joint_of(scene.index(body)) is not None
    return scene.filled(state) if on_joint and quantity not in ("q", "v") else state


def _difference(scene: Scene, state: State, body: str, quantity: str, value: Array, axes: str) -> Array:
    i, layout = scene.index(body), scene.layout
    if quantity in ("q", "v"):
        joint = layout.joint_of(i)
        numbers = getattr(state, quantity)
        assert joint is not None and numbers is not None
        place = layout.coordinates[joint]
        return numbers[place : place + 1] - value
    if quantity == "orientation":
        error = maths.quat_log(maths.quat_multiply(maths.quat_conjugate(value), state.orientation[i]))
    else:
        error = getattr(state, quantity)[i] - value
    return error if axes == _AXES else error[np.array([_AXES.index(axis) for axis in axes])]


def _checked_axes(axes: str, what: str) -> str:
    if (
        not isinstance(axes, str)
        or not axes
        or any(axis not in _AXES or axes.count(axis) > 1 for axis in axes)
    ):
        raise ValueError(f"axes of {what} must be different letters of 'xyz', got {axes!r}")
    return axes


def _checked_value(quantity: str, value: maths.Numbers, what: str) -> Array:
    if quantity not in QUANTITIES:
        raise ValueError(
            f"quantity {what} must be one of {', '.join(QUANTITIES)}, got {quantity!r}"
            + did_you_mean(quantity, QUANTITIES)
        )
    if quantity == "orientation":
        return maths.checked_quaternion(f"orientation {what}", value)
    shape = () if QUANTITIES[quantity] == 1 else (QUANTITIES[quantity],)
    return jnp.atleast_1d(maths.checked_array(f"{quantity} {what}", value, shape))


def _spread(name: str, value: maths.Numbers, n: int) -> Array:
    array = maths.checked_numbers(name, value)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{name} must be one number or {n}, got shape {array.shape}")
    return maths.checked_array(name, np.broadcast_to(array, (n,)), (n,))
