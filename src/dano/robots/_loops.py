"""States in which loops are closed."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dano.checks import checked_items, checked_kind
from dano.names import did_you_mean
from dano.scene import Scene, State

# Gap [m, rad] at which loops count as closed in float64, in float32, and steps to get there.
_CLOSED, _FLOAT32, _STEPS = 1e-12, 1e-5, 60
# Largest change of a coordinate in a step [rad or m].
_LONGEST = 0.5


def loop_gaps(scene: Scene, state: State) -> Float[Array, " c"]:
    """How far the loops of a scene are from being closed at a state, see `Loops.gaps`.

    Raises:
        ValueError: If the state does not fit the scene, or it has no loops.
    """
    checked_kind("scene", scene, Scene)
    loops = scene.closing
    if loops is None:
        raise ValueError("scene must have loops, got none")
    frames = scene.frames(state)
    return loops.gaps(frames.position, frames.orientation)


def close_loops(scene: Scene, state: State, hold: Sequence[str] = ()) -> State:
    """The state near to one in which the loops of a scene are closed, and stay so with its velocities.

    Joint coordinates change as little as closing takes (Newton's method with the pseudoinverse). Bodies that
    move freely stay where they are.

    Args:
        scene: A scene with loops.
        state: Where to start.
        hold: Bodies whose joints keep their coordinates, such as a crank.

    Raises:
        ValueError: If the scene has no loops, a body hangs on no joint, or loops stay open: the error says by
            how much.
    """
    gaps = loop_gaps(scene, state)
    hold = checked_items("hold", hold, str)
    moves = _free_columns(scene, hold)
    limit = _CLOSED if gaps.dtype == jnp.float64 else _FLOAT32
    assert state.q is not None and state.v is not None
    q = state.q
    for _ in range(_STEPS):
        gaps, slopes = _gaps_and_slopes(scene, state, q)
        if float(jnp.max(jnp.abs(gaps))) <= limit:
            break
        step = -np.linalg.lstsq(np.asarray(slopes)[:, moves], np.asarray(gaps), rcond=1e-9)[0]
        step *= min(1.0, _LONGEST / max(1e-12, float(np.abs(step).max(initial=0.0))))
        q = q.at[moves].add(step)
    gaps, slopes = (np.asarray(x) for x in _gaps_and_slopes(scene, state, q))
    if not np.abs(gaps).max() <= 100 * limit:
        held = f" with {', '.join(map(repr, hold))} held" if hold else ""
        raise ValueError(
            f"loops must be closed by the joints{held}, got a gap of {np.abs(gaps).max():.3g} m or rad at"
            f" {_worst(scene, gaps)} where it is smallest near the start"
        )
    v = np.asarray(state.v, float)
    missed = slopes @ v
    v = v.copy()
    v[moves] -= np.linalg.lstsq(slopes[:, moves], missed, rcond=1e-9)[0]
    return scene.filled(dataclasses.replace(state, q=q, v=jnp.asarray(v, q.dtype)))


def _free_columns(scene: Scene, hold: Sequence[str]) -> np.ndarray:
    """Places among q that may change."""
    layout = scene.layout
    held: set[int] = set()
    children = {joint.child: j for j, joint in enumerate(scene.joints) if layout.width(j)}
    for name in hold:
        if name not in children:
            hint = did_you_mean(name, children)
            raise ValueError(f"hold must name bodies on joints {list(children)}, got {name!r}{hint}")
        first = layout.coordinates[children[name]]
        held |= set(range(first, first + layout.width(children[name])))
    return np.array([i for i in range(layout.n_joints) if i not in held], int)


@eqx.filter_jit
def _gaps_and_slopes(scene: Scene, state: State, q: Float[Array, " k"]):
    def gaps(q):
        return loop_gaps(scene, dataclasses.replace(state, q=q))

    return gaps(q), jax.jacfwd(gaps)(q)


def _worst(scene: Scene, gaps: np.ndarray) -> str:
    row = int(np.abs(gaps).argmax())
    loops = scene.loops
    welds = [loop for loop in loops if loop.kind == "weld"]
    loop = loops[row // 3] if row < 3 * len(loops) else welds[row // 3 - len(loops)]
    return f"the loop of {loop.first or 'the world'!r} and {loop.second!r}"
