"""States from joint coordinates in machine code, see `filled`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dano.contact import changes_of, numbers_of
from dano.scene._joints import Layout
from dano.scene._states import State

# Numbers of a body: position, orientation, velocity, omega.
_ROW, _ENDS = 13, (3, 7, 10)


def fills_natively() -> bool:
    """Whether machine code does it."""
    return jax.default_backend() == "cpu"


@eqx.filter_custom_jvp
def _fill(tables, layout: Layout, resolved: float) -> Float[Array, "j 13"]:
    """Poses and velocities of the bodies on joints."""
    from dano.native.trees import tree_filling_name  # compiles or loads the kernel, so only where it is used

    dtype = tables[0].dtype
    return jax.ffi.ffi_call(
        tree_filling_name(dtype),
        jax.ShapeDtypeStruct((len(layout.children), _ROW), dtype),
        vmap_method="sequential",
    )(*tables, layout.nodes, np.array([resolved], dtype))


@_fill.def_jvp
def _(primals, tangents):
    from dano.native.trees import tree_filling_slopes_name

    (tables, layout, resolved), (changes, _, _) = primals, tangents
    rows, dtype = _fill(tables, layout, resolved), tables[0].dtype
    chosen = _changing(layout, [x.shape for x in tables], [x is not None for x in changes])
    if not len(chosen):
        return rows, jnp.zeros_like(rows)
    slopes = jax.ffi.ffi_call(
        tree_filling_slopes_name(dtype),
        jax.ShapeDtypeStruct((len(chosen), rows.size), dtype),
        vmap_method="sequential",
    )(*tables, layout.nodes, np.array([resolved], dtype), chosen)
    return rows, (changes_of(changes, chosen) @ slopes).reshape(rows.shape)


def fill(
    joints: Float[Array, "j 15"],
    com: Float[Array, "n 3"],
    layout: Layout,
    state: State,
    h: Float[Array, ""],
    resolved: float,
) -> State:
    """See `filled`; resolved is `RESOLVED`, joints are `Chains.table`."""
    assert state.q is not None and state.v is not None
    dtype = state.position.dtype
    rows = np.array(layout.children)
    com = jnp.concatenate([com, jnp.zeros((1, 3), dtype)])
    parts = state.position, state.orientation, state.velocity, state.omega
    tables = (*parts, state.q[None], state.v[None], com, joints, h[None, None])
    found = _fill(tuple(x.astype(dtype) for x in tables), layout, resolved)
    ends = zip(parts, jnp.split(found, _ENDS, axis=1), strict=True)
    return State(*(x.at[rows].set(new.astype(x.dtype)) for x, new in ends), q=state.q, v=state.v)


def _changing(
    layout: Layout, shapes: list[tuple[int, ...]], perturbed: list[bool]
) -> Int[np.ndarray, "changes 3"]:
    """By which numbers of the tables bodies on joints move: table, row and column of each."""
    stands = set(layout.parents) - set(layout.children)
    carriers = [i for i in range(layout.bodies) if i in stands]
    moving = [i for i in carriers if i in layout.free]
    joined = sorted((set(layout.parents) | set(layout.children)) - {layout.bodies})
    rows = [carriers, carriers, moving, moving, [0], [0], joined, range(len(layout.children)), [0]]
    return numbers_of(zip(rows, (width for _, width in shapes), strict=True), perturbed)
