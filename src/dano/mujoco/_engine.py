"""MuJoCo as an engine of our scenes.

MuJoCo has no derivatives of its own: those of a step are central differences of it, with respect to states,
controls, masses, inertias, frictions, gravity and the timestep.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.callback import host_callback
from dano.checks import checked_choice, checked_kind, checked_number
from dano.contact import Patch
from dano.engine import AbstractEngine, marked, Report, VariationalEngine
from dano.maths import AnyArray
from dano.mujoco._spec import TOUCHES
from dano.mujoco._things import library
from dano.mujoco._twin import Constants, Motion, Twin
from dano.names import did_you_mean
from dano.scene import Control, lifted, Scene, State


class _Place(NamedTuple):
    """Where the numbers of a step stand in one vector: shapes, which matter, and the step of differences."""

    shapes: tuple[tuple[int, ...], ...]
    used: tuple[int, ...]
    step: float


class MuJoCoEngine(AbstractEngine):
    """Steps a scene in MuJoCo: same bodies, joints, loops, motors and pairs, MuJoCo's contact.

    At its defaults but for elliptic friction cones with impratio 10, which hold bodies on slopes, and the
    integrator "implicit", with which bodies that tumble gain no energy. Options may say otherwise.

    Neural objects touch by their samples, as through `Bridge`, or as meshes of their solids. Of a contact's
    parameters the sliding friction and the restitution count; the stiffness is MuJoCo's own. Springs of
    contacts are damped so that they rebound as the restitution says, but all rebound by 0.13 or more: that is
    what MuJoCo's default does.

    Joints, and what acts on them, are MuJoCo's: loops and limits give way a little, friction holds by
    MuJoCo's solver, springs and position motors pull by where joints are at the start of a step. So a motor
    whose stiffness exceeds four times what it moves per h² is unstable.

    Shapes, samples, centres of mass and the places of joints are those of the scene that the engine was made
    for, other numbers those of the scene that is stepped.

    A step calls MuJoCo on the host, one rollout after the other also under `jax.vmap`. Derivatives are
    central differences of MuJoCo's step, forward and reverse; with respect to shapes, samples, centres of
    mass and places of joints they are zero. MuJoCo's contact forces jump where a point begins to touch, and
    differences across a jump are large: what they say of a rollout with impacts is of little use.
    """

    names: tuple[str, ...] = eqx.field(static=True)  # Bodies of the scene (static)
    # As what neural objects touch: "samples", "hull" or "distance" (static).
    objects: str = eqx.field(static=True)
    # Step of the differences in SI units, of masses, inertias, timesteps a share (static).
    difference: float = eqx.field(static=True)
    _twin: Twin = eqx.field(static=True)

    def __init__(
        self,
        scene: Scene,
        *,
        objects: str = "samples",
        options: Mapping[str, Any] | None = None,
        difference: float = 1e-6,
    ):
        """Build the model of a scene.

        Args:
            scene: The scene.
            objects: As what neural objects touch: by their "samples"; or a mesh of their solid, which MuJoCo
                takes as its convex "hull", or between two of them by its signed "distance" (from 4.0).
            options: Of MuJoCo's `mjOption` by their names, such as `impratio` or `iterations`; gravity and
                timestep are the scene's.
            difference: See the class.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If nothing in the scene moves, a shape is not a geom of MuJoCo's, an object has no
                solid for a mesh, or an option is out of range.
        """
        checked_kind("scene", scene, Scene)
        difference = checked_number("difference", difference, above=0)
        checked_choice("objects", objects, list(TOUCHES))
        if not any(not body.fixed for body in scene.bodies):
            raise ValueError("scene must have a body that moves, got only fixed ones")
        self.names, self.difference = scene.names, float(difference)
        self.objects = objects
        self._twin = Twin(scene, objects, _checked_options(options or {}))

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`."""
        return self._twin.model

    @property
    def bridge(self) -> Any:
        """What MuJoCo's own loop runs in: `with engine.bridge: mujoco.mj_step(engine.model, data)`."""
        return self._twin.bridge

    def data(self, scene: Scene, state: State, control: Control | None = None) -> Any:
        """A new `mujoco.MjData` at a state, for MuJoCo's own loop, viewer or renderer.

        The model gets the numbers of the scene, too.

        Raises:
            ValueError: If the state does not fit the scene, or the scene the engine.
        """
        self._check(scene)
        scene.check_state(state)
        data = library().MjData(self.model)
        self._twin.load(
            data, Motion(*_doubles(_motion(state))), Constants(*_doubles(_constants(scene, control)))
        )
        return data

    def state(self, scene: Scene, data: Any) -> State:
        """The state that an `mujoco.MjData` of this engine's model is in.

        Raises:
            ValueError: If the scene is not the engine's.
        """
        self._check(scene)
        empty = scene.initial_state()
        found = self._twin.read(data, Motion(*_doubles(_motion(empty))))
        dtype = scene.timestep.dtype
        return _filled(scene, State(*(jnp.asarray(x, dtype) for x in found), names=scene.names))

    def _check(self, scene: Scene) -> None:
        scene.check_weighed()
        if scene.names != self.names:
            raise ValueError(f"scene must have the bodies {list(self.names)}, got {list(scene.names)}")
        joints = tuple((joint.parent, joint.child, joint.kind) for joint in scene.joints)
        joints += tuple((loop.first, loop.second, loop.kind) for loop in scene.loops)
        if joints != self._twin.joints:
            raise ValueError(
                f"scene must have the joints and loops {list(self._twin.joints)}, got {list(joints)}"
            )

    def prepare(self, scene: Scene) -> Any:
        """See `AbstractEngine.prepare`.

        Raises:
            ValueError: If the scene has other bodies or joints than the one that the engine was made for.
        """
        self._check(scene)
        return VariationalEngine().prepare(scene)

    def step(
        self, scene: Scene, prepared: Any, state: State, control: Control | None
    ) -> tuple[State, Report]:
        """See `AbstractEngine.step`. A step counts as converged when MuJoCo's result is finite."""
        numbers = (*_motion(state), *_constants(scene, control))
        dtype = state.position.dtype
        shapes = tuple(x.shape for x in numbers)
        place = _Place(shapes, _used(scene, shapes), self.difference)
        flat = jnp.concatenate([x.astype(dtype).ravel() for x in numbers])
        out = _advance(self._twin, place, flat)
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes[: len(Motion._fields)]])
        *parts, passes = jnp.split(out, ends)
        rows = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=False)]
        after = _filled(scene, State(*rows, names=state.names))
        bad = ~jnp.all(jnp.isfinite(out))
        passes = jax.lax.stop_gradient(passes[0]).astype(int)
        report = Report(jnp.where(bad, jnp.inf, 0).astype(dtype), passes, ~bad)
        # MuJoCo begins anew where a number is not finite.
        one = jax.tree.map(lambda x: x[None], (control, after, report))
        return jax.tree.map(lambda x: x[0], marked(prepared.sound, state, *one))

    def touch(self, scene: Scene, prepared: Any, state: State) -> Patch:
        """See `AbstractEngine.touch`: the overlap of the same samples and solids as in our own engine."""
        return VariationalEngine().touch(scene, prepared, state)

    def wrenches(
        self, scene: Scene, prepared: Any, before: State, after: State, about: Float[Array, "contacts 3"]
    ) -> Float[Array, "contacts 6"]:
        """See `AbstractEngine.wrenches`: MuJoCo's own forces, by its inverse dynamics of the step."""
        constants = _constants(scene, None)
        result = jax.ShapeDtypeStruct((len(scene.pairs), 6), about.dtype)

        def host(before, after, constants, about):
            found = self._twin.wrenches(
                Motion(*_doubles(before)),
                Motion(*_doubles(after)),
                Constants(*_doubles(constants)),
                np.asarray(about, np.float64),
            )
            return found.astype(result.dtype)

        arguments = _motion(before), _motion(after), constants, about
        return host_callback(host, result, *arguments)


def _checked_options(options: Mapping[str, Any]) -> Mapping[str, Any]:
    library_options = library().MjOption()
    valid = [x for x in dir(library_options) if not x.startswith("_") and x not in ("gravity", "timestep")]
    for name in options:
        if name not in valid:
            raise ValueError(
                f"options must be of {', '.join(valid)}, got {name!r}{did_you_mean(name, valid)}"
            )
    return options


def _filled(scene: Scene, state: State) -> State:
    """With rows of bodies on joints as the joints say; without q and v if there are none."""
    return scene.filled(state) if scene.joints else dataclasses.replace(state, q=None, v=None)


def _motion(state: State) -> tuple[Array, ...]:
    """The numbers of `Motion`."""
    none = jnp.zeros(0, state.position.dtype)
    joints = (none, none) if state.q is None or state.v is None else (state.q, state.v)
    return state.position, state.orientation, state.velocity, state.omega, *joints


def _constants(scene: Scene, control: Control | None) -> tuple[AnyArray, ...]:
    """The numbers of `Constants`."""
    dtype, laws, k = scene.timestep.dtype, scene.chains.laws, scene.layout.n_joints
    still, idle = jnp.zeros((len(scene.bodies), 3), dtype), jnp.zeros(k, dtype)

    def given(value: AnyArray | None, default: AnyArray) -> AnyArray:
        return default if value is None else value

    control = lifted(scene, control)
    pushed = (still, still, None, None)
    if control is not None:
        pushed = control.force, control.torque, control.effort, control.command
    return (
        pushed[0],
        pushed[1],
        given(pushed[2], idle),
        given(pushed[3], idle),
        jnp.stack([body.mass * body.mass_scale for body in scene.bodies]),
        jnp.stack([body.inertia * body.mass_scale for body in scene.bodies]),
        _of_pairs(scene, "sliding_friction"),
        _of_pairs(scene, "restitution"),
        scene.gravity,
        scene.timestep,
        laws.damping,
        given(laws.armature, idle),
        given(laws.stiffness, idle),
        laws.rest,
        given(laws.friction, idle),
        given(laws.limits, jnp.broadcast_to(jnp.asarray([-jnp.inf, jnp.inf], dtype), (k, 2))),
        given(laws.motor, jnp.zeros((k, 5), dtype)),
    )


def _of_pairs(scene: Scene, name: str) -> Float[Array, " p"]:
    """A parameter of all pairs; zero where a law does not read it."""
    dtype = scene.timestep.dtype
    own = [getattr(contact.params, name) for contact in scene.contacts]
    values = [jnp.zeros(1, dtype) if value is None else value[None] for value in own]
    if scene.others is not None:
        values.append(getattr(scene.others.pair_params, name))
    return jnp.concatenate(values) if values else jnp.zeros(0, dtype)


def _used(scene: Scene, shapes: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Numbers on which a step depends: of fixed bodies only where they are, of those on joints nothing."""
    layout, laws = scene.layout, scene.chains.laws
    fixed = np.array([body.fixed for body in scene.bodies])
    hangs = np.isin(np.arange(len(fixed)), layout.children)
    owners = [scene.joints[j] for j in layout.with_coordinates]
    no_motor = np.array([joint.motor is None for joint in owners], bool)
    unused = {
        **dict.fromkeys(("position", "orientation"), hangs),
        **dict.fromkeys(("velocity", "omega"), fixed | hangs),
        **dict.fromkeys(("force", "torque", "mass", "inertia"), fixed),
        **dict.fromkeys(("command", "motor"), no_motor),
        "limits": np.array([joint.limits is None for joint in owners], bool),
        "armature": laws.armature is None,
        **dict.fromkeys(("stiffness", "rest"), laws.stiffness is None),
        "stiction": laws.friction is None,
    }
    used = []
    for name, shape in zip((*Motion._fields, *Constants._fields), shapes, strict=True):
        mask = np.ones(shape, bool)
        mask[unused.get(name, False)] = False
        used.append(mask.ravel())
    return tuple(np.flatnonzero(np.concatenate(used)).tolist())


@eqx.filter_custom_jvp
def _advance(twin: Twin, place: _Place, flat: Float[Array, " n"]) -> Float[Array, " m"]:
    """The state after a step in one vector, then the passes of the solver."""
    result = jax.ShapeDtypeStruct((_size_out(place),), flat.dtype)
    return host_callback(lambda x: _stepped(twin, place, x).astype(result.dtype), result, flat)


@_advance.def_jvp
def _(primals, tangents):
    twin, place, flat = primals
    out = _advance(twin, place, flat)
    change = tangents[2]
    if change is None:
        return out, jnp.zeros_like(out)
    result = jax.ShapeDtypeStruct((_size_out(place), len(place.used)), flat.dtype)
    jacobian = host_callback(lambda x: _differences(twin, place, x).astype(result.dtype), result, flat)
    return out, jacobian @ change[np.array(place.used)]


def _size_out(place: _Place) -> int:
    return sum(int(np.prod(shape)) for shape in place.shapes[: len(Motion._fields)]) + 1


def _stepped(twin: Twin, place: _Place, flat: Any) -> Float[np.ndarray, " m"]:
    ends = np.cumsum([int(np.prod(shape)) for shape in place.shapes])
    parts = np.split(np.asarray(flat, np.float64), ends[:-1])
    numbers = [part.reshape(shape) for part, shape in zip(parts, place.shapes, strict=True)]
    k = len(Motion._fields)
    after, passes = twin.step(Motion(*numbers[:k]), Constants(*numbers[k:]))
    return np.concatenate([*(x.ravel() for x in after), [passes]])


def _differences(twin: Twin, place: _Place, flat: Any) -> Float[np.ndarray, "m k"]:
    x = np.asarray(flat, np.float64)
    steps = place.step * _sizes(place, x)
    columns = []
    for i in place.used:
        ends = []
        for side in (1, -1):
            moved = x.copy()
            moved[i] += side * steps[i]
            ends.append(_stepped(twin, place, moved))
        columns.append((ends[0] - ends[1]) / (2 * steps[i]))
    found = np.stack(columns, axis=1)
    found[-1] = 0
    return found


def _sizes(place: _Place, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """What differences are shares of: 1, but masses, inertias and the timestep themselves."""
    ends = np.cumsum([int(np.prod(shape)) for shape in place.shapes])
    sizes = []
    names = (*Motion._fields, *Constants._fields)
    for name, shape, part in zip(names, place.shapes, np.split(x, ends[:-1]), strict=True):
        size = np.ones(shape)
        if name in ("mass", "timestep"):
            size = part.reshape(shape)
        elif name == "inertia":
            size = size * np.abs(part.reshape(shape)).max(axis=(1, 2), keepdims=True)
        sizes.append(size.ravel())
    return np.concatenate(sizes)


def _doubles(arrays: Any) -> list[np.ndarray]:
    return [np.asarray(x, np.float64) for x in arrays]
