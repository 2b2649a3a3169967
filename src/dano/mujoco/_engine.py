"""MuJoCo as an engine of our scenes.

MuJoCo has no derivatives of its own: those of a step are central differences of it, with respect to states,
controls, masses, inertias, frictions, gravity and the timestep.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.contact import Patch
from dano.engine import AbstractEngine, Report, VariationalEngine
from dano.mujoco._twin import Constants, Motion, Twin
from dano.scene import Control, Scene, State


class _Place(NamedTuple):
    """Where the numbers of a step stand in one vector: shapes, which matter, and the step of differences."""

    shapes: tuple[tuple[int, ...], ...]
    used: tuple[int, ...]
    step: float


class MuJoCoEngine(AbstractEngine):
    """Steps a scene in MuJoCo: same bodies and pairs, MuJoCo's contact.

    At its defaults but for elliptic friction cones with impratio 10, which hold bodies on slopes, and the
    integrator "implicit", with which bodies that tumble gain no energy.

    Neural objects touch by their samples, as through `Bridge`. Of a contact's parameters the sliding friction
    counts; MuJoCo has no coefficient of restitution, and its stiffness is its own. Shapes, samples, centres
    of mass are those of the scene that the engine was made for, other numbers those of the scene that is
    stepped.

    A step calls MuJoCo on the host, one rollout after the other also under `jax.vmap`. Derivatives are
    central differences of MuJoCo's step, forward and reverse; with respect to shapes, samples and centres of
    mass they are zero. MuJoCo's contact forces jump where a point begins to touch, and differences across a
    jump are large: what they say of a rollout with impacts is of little use.

    Attributes:
        names: Bodies of the scene (static).
        difference: Step of the differences in SI units, of masses, inertias, timesteps a share (static).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    difference: float = eqx.field(static=True)
    _twin: Twin = eqx.field(static=True)

    def __init__(self, scene: Scene, *, difference: float = 1e-6):
        """Build the model of a scene.

        Args:
            scene: The scene.
            difference: See the class.

        Raises:
            ImportError: If mujoco is missing.
            ValueError: If the scene has joints, nothing that moves, or a shape that is no geom of MuJoCo's,
                or the difference is not positive.
        """
        if not difference > 0:
            raise ValueError(f"difference must be > 0, got {difference}")
        if not any(not body.fixed for body in scene.bodies):
            raise ValueError("scene must have a body that moves, got only fixed ones")
        self.names, self.difference = scene.names, float(difference)
        self._twin = Twin(scene)

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`."""
        return self._twin.model

    def prepare(self, scene: Scene) -> Any:
        """See `AbstractEngine.prepare`.

        Raises:
            ValueError: If the scene has other bodies than the one that the engine was made for.
        """
        if scene.names != self.names:
            raise ValueError(f"scene must have the bodies {list(self.names)}, got {list(scene.names)}")
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
        n = len(scene.bodies)
        parts = jnp.split(out, [3 * n, 7 * n, 10 * n, 13 * n])
        after = State(*(part.reshape(n, -1) for part in parts[:4]))
        bad = ~jnp.all(jnp.isfinite(out))
        passes = jax.lax.stop_gradient(parts[4][0]).astype(int)
        return after, Report(jnp.where(bad, jnp.inf, 0).astype(dtype), passes, ~bad)

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
        return jax.pure_callback(host, result, *arguments, vmap_method="sequential")


def _motion(state: State) -> tuple[Array, ...]:
    """The numbers of `Motion`."""
    return state.position, state.orientation, state.velocity, state.omega


def _constants(scene: Scene, control: Control | None) -> tuple[Array, ...]:
    """The numbers of `Constants`."""
    zero = jnp.zeros((len(scene.bodies), 3), scene.timestep.dtype)
    frictions = [contact.params.sliding_friction[None] for contact in scene.contacts]
    if scene.others is not None:
        frictions.append(scene.others.pair_params.sliding_friction)
    friction = jnp.concatenate(frictions) if frictions else jnp.zeros(0, zero.dtype)
    return (
        zero if control is None else control.force,
        zero if control is None else control.torque,
        jnp.stack([body.mass * body.mass_scale for body in scene.bodies]),
        jnp.stack([body.inertia * body.mass_scale for body in scene.bodies]),
        friction,
        scene.gravity,
        scene.timestep,
    )


def _used(scene: Scene, shapes: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """Numbers on which a step depends: of fixed bodies only where they are."""
    fixed = np.array([body.fixed for body in scene.bodies])
    used = []
    for name, shape in zip((*Motion._fields, *Constants._fields), shapes, strict=True):
        mask = np.ones(shape, bool)
        if name in ("velocity", "omega", "force", "torque", "mass", "inertia"):
            mask[fixed] = False
        used.append(mask.ravel())
    return tuple(np.flatnonzero(np.concatenate(used)).tolist())


@eqx.filter_custom_jvp
def _advance(twin: Twin, place: _Place, flat: Float[Array, " n"]) -> Float[Array, " m"]:
    """The state after a step in one vector, then the passes of the solver."""
    result = jax.ShapeDtypeStruct((_size_out(place),), flat.dtype)
    return jax.pure_callback(
        lambda x: _stepped(twin, place, x).astype(result.dtype), result, flat, vmap_method="sequential"
    )


@_advance.def_jvp
def _(primals, tangents):
    twin, place, flat = primals
    out = _advance(twin, place, flat)
    change = tangents[2]
    if change is None:
        return out, jnp.zeros_like(out)
    result = jax.ShapeDtypeStruct((_size_out(place), len(place.used)), flat.dtype)
    jacobian = jax.pure_callback(
        lambda x: _differences(twin, place, x).astype(result.dtype), result, flat, vmap_method="sequential"
    )
    return out, jacobian @ change[np.array(place.used)]


def _size_out(place: _Place) -> int:
    return 13 * place.shapes[0][0] + 1


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
