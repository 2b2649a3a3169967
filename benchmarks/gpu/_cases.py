"""Scenes whose rollouts a launch of a kernel makes, and the programs that are timed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._subjects import shipped_bunny
from benchmarks.robots.push import panda
from benchmarks.robots.push._case import BEHIND, BUNNY, DOWN, HEIGHT, RADIUS, READY
from benchmarks.speed._arms import strikes
from benchmarks.speed._crowds import crowds
from benchmarks.speed._dano import FRICTION, sliding

# Chunks of points that a world has room for: more than ever touch in these scenes.
_BUNNY_ROOM, _BOXES_ROOM, _BOWL_ROOM = 16, 32, 64
# Of the bowl: radius, half of its wall, and the cell of its grid [m].
_BOWL, _WALL, _CELL = 0.2, 0.01, 0.008


@dataclass(frozen=True)
class Case:
    """Rollouts of a scene that differ in a velocity.

    Attributes:
        name: For the table.
        scene: The scene.
        state: Where all begin.
        worlds: How many at once.
        narrow: Whether numbers have 32 bits.
        backward: Whether reverse mode is timed, too.
        room: Chunks of points.
        control: What motors are told in all steps, None for nothing.
    """

    name: str
    scene: dano.Scene
    state: dano.State
    worlds: int
    narrow: bool = False
    backward: bool = False
    room: int = _BUNNY_ROOM
    control: dano.Control | None = None

    def begun(self, leaves: Sequence[np.ndarray]) -> "Case":
        """The same rollouts from the numbers of a state that another machine found."""
        begun = jax.tree.unflatten(jax.tree.structure(self.state), [jnp.asarray(x) for x in leaves])
        return replace(self, state=begun)

    def inputs(self, worlds: int) -> tuple[dano.Scene, dano.State, jax.Array]:
        """What a program is given: arrays of the scene, the state, velocities of each world's first body."""
        arrays = eqx.filter(self.scene, eqx.is_array)
        shaken = jnp.linspace(0.8, 1.2, worlds)[:, None] * self.state.velocity[0]
        given = arrays, self.state, shaken
        return self._narrowed(given)

    def _narrowed(self, arrays: Any) -> Any:
        """A tree of arrays in float32 where the case is."""
        if not self.narrow:
            return arrays
        return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, arrays)

    def program(self, n_steps: int) -> Callable[..., tuple[jax.Array, jax.Array]]:
        """Positions at the ends of all steps, and which steps were solved, of all worlds."""
        static = eqx.filter(self.scene, eqx.is_array, inverse=True)
        controls = self._narrowed(jax.tree.map(lambda x: x[None].repeat(n_steps, axis=0), self.control))

        def rolled(arrays: dano.Scene, state: dano.State, shaken: jax.Array) -> tuple[jax.Array, jax.Array]:
            scene = eqx.combine(arrays, static)
            engine = dano.VariationalEngine(capacity=self.room)
            prepared = engine.prepare(scene)

            def one(first: jax.Array) -> tuple[jax.Array, jax.Array]:
                begun = eqx.tree_at(lambda s: s.velocity, state, state.velocity.at[0].set(first))
                found = engine.rollout(scene, prepared, scene.filled(begun), controls, n_steps)
                assert found is not None
                states, report = found
                return states.position, report.converged

            return jax.vmap(one)(shaken)

        return rolled

    def gradient(self, n_steps: int) -> Callable[..., jax.Array]:
        """Derivatives of where the first bodies end, by their first velocities."""
        rolled = self.program(n_steps)

        def ends(shaken: jax.Array, arrays: dano.Scene, state: dano.State) -> jax.Array:
            return jnp.sum(rolled(arrays, state, shaken)[0][:, -1, 0] ** 2)

        return lambda arrays, state, shaken: jax.grad(ends)(shaken, arrays, state)


def cases() -> dict[str, Callable[[], Case]]:
    """All cases by a short name; made when asked for."""
    return {
        "bunny": lambda: _bunny("bunny slides, float64", backward=True),
        "bunny32": lambda: _bunny("bunny slides, float32", narrow=True),
        "boxes": _boxes,
        "panda": _panda,
        "bowl": _bowl,
        "strikes": _strikes,
    }


def _bunny(name: str, **settings: Any) -> Case:
    subject = shipped_bunny()
    bodies = [dano.Body("bunny", subject.bunny), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    contact = dano.Contact("bunny", "floor", dano.ContactParams(sliding_friction=FRICTION))
    scene = dano.Scene.create(bodies, [contact], timestep=subject.timestep)
    return Case(name, scene, sliding(subject, subject.settled(scene)), 4096, **settings)


def _boxes() -> Case:
    crowd = next(each for each in crowds() if each.name == "8 boxes")
    bodies = [dano.Body(f"b{i}", dano.Box((0.05,) * 3), mass=1.0) for i in range(len(crowd.members))]
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    scene = dano.Scene.create(
        [*bodies, floor], others=dano.ContactParams(sliding_friction=FRICTION), timestep=0.005
    )
    starts: dict[str, dict[str, Any]] = {
        f"b{i}": {"position": one.position, "orientation": one.orientation, "velocity": (0, 0, -0.5)}
        for i, one in enumerate(crowd.members)
    }
    return Case("8 boxes fall", scene, scene.initial_state(**starts), 1024, room=_BOXES_ROOM)


def _panda() -> Case:
    """The arm with a ball for a tool moves through the bunny's place; its joints have been set in motion."""
    path = panda()
    if path is None:
        raise FileNotFoundError("the Panda is not there: pip install frax")
    robot, subject = dano.load_urdf(path, collision=False), shipped_bunny()
    tool = dano.Body("tool", dano.Sphere(RADIUS), mass=0.2)
    weld = dano.Joint(robot.bodies[-1].name, "tool", "weld", position=(0, 0, 0.2))
    floor = dano.Body("floor", dano.HalfSpace(), fixed=True)
    params = dano.ContactParams(sliding_friction=FRICTION)
    scene = dano.Scene.create(
        [dano.Body("bunny", subject.bunny), *robot.bodies, tool, floor],
        [dano.Contact("bunny", "floor", params), dano.Contact("tool", "bunny", params)],
        joints=[*robot.joints, weld],
        timestep=0.002,
    )
    names = [body.name for body in robot.bodies]
    place = np.append(BUNNY, 0.06)
    first = scene.initial_state(
        bunny={"position": place, "velocity": (0.01, 0, 0)},
        **{name: {"q": q} for name, q in zip(names, READY, strict=True)},
    )
    hand = np.array([place[0] - BEHIND, place[1], HEIGHT + 0.2])
    target = dano.Target(names[-1], position=hand, orientation=DOWN)
    found = dano.inverse_kinematics(robot, scene, first, [target])
    assert found.reached, found.reason
    assert found.state.v is not None
    moving = found.state.v.at[3].set(0.5)
    state = eqx.tree_at(lambda s: s.v, found.state, moving)
    return Case("Panda pushes the bunny", scene, state, 4096, room=_BUNNY_ROOM)


def _bowl() -> Case:
    """Four bunnies fall into the lower half of a hollow ball."""
    n = round(2 * (_BOWL + 4 * _WALL) / _CELL) + 1
    axis = _CELL * (np.arange(n) - (n - 1) / 2)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distances = np.maximum(np.abs(np.sqrt(x * x + y * y + z * z) - _BOWL) - _WALL, z)
    grid = dano.fields.SignedDistanceGrid(distances, (axis[0],) * 3, _CELL)
    bowl = dano.NeuralObject.from_field(grid, mass=1.0)
    bunny = shipped_bunny().bunny
    names = [f"bunny {i}" for i in range(4)]
    scene = dano.Scene.create(
        [*(dano.Body(name, bunny) for name in names), dano.Body("bowl", bowl, fixed=True)],
        others=dano.ContactParams(sliding_friction=FRICTION),
        timestep=0.005,
    )
    starts: dict[str, dict[str, Any]] = {
        name: {
            "position": (0.07 * (1 - 2 * (i % 2)), 0.07 * (1 - 2 * (i // 2)), 0.0),
            "velocity": (0, 0, -0.5),
        }
        for i, name in enumerate(names)
    }
    com = np.asarray(bowl.mass.com)
    state = scene.initial_state(**starts, bowl={"position": com})
    return Case("four bunnies in a bowl", scene, state, 1024, room=_BOWL_ROOM)


def _strikes() -> Case:
    """The arm of `benchmarks.speed`, whose motors turn it until it strikes a box, which slides a little."""
    if panda() is None:
        raise FileNotFoundError("the Panda is not there: pip install frax")
    arm = strikes()
    sliding_box = arm.state.velocity.at[arm.scene.index("box")].set(jnp.array([0.01, 0.0, 0.0]))
    state = eqx.tree_at(lambda s: s.velocity, arm.state, sliding_box)
    return Case(arm.name, arm.scene, state, 4096, control=arm.control)
