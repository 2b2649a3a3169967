"""Fields given by a function of points, written for JAX, NumPy or PyTorch."""

import functools
import sys
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from dano.callback import batched_callback
from dano.checks import checked_number
from dano.fields._base import AbstractField, check_order, Jet, vmapped_jet
from dano.maths import checked_floating, is_traced, Numbers

Framework = Literal["jax", "numpy", "torch"]

_N_PROBES = 512
"""Points at which a function is tried when the field is built."""


class CallableField(AbstractField):
    """A density given by a function of a batch of points, (n, 3) -> (n,), each point on its own.

    A JAX function is traced: it runs at full speed and differentiates by JAX. NumPy and PyTorch functions are
    called on the host, once per batch (also under `jax.vmap`), which suits building objects and baking rather
    than simulation; bake them for that. PyTorch gradients come from its autograd; NumPy gradients are central
    differences of `step`.
    """

    # The function if it is an `equinox.Module`, whose arrays are then leaves of this field; else None.
    module: Any
    function: Any = eqx.field(static=True)  # Any other function (static)
    box: Float[Array, "2 3"]  # Lower and upper corner [m, F]; the density is zero outside
    framework: Framework = eqx.field(static=True)  # "jax", "numpy" or "torch" (static)
    step: float = eqx.field(static=True)  # Central-difference step [m] of NumPy gradients (static)

    def __init__(
        self,
        function: Callable,
        bounds: Numbers,
        framework: Framework | None = None,
        *,
        step: float | None = None,
    ):
        """Build a field from a function and try it at a few hundred points.

        Args:
            function: Maps points [m, F], shape (n, 3), to densities ≥ 0, shape (n,), for any n ≥ 1. NumPy
                functions get float64 arrays; PyTorch functions tensors of their parameters' (or torch's
                default) dtype and device.
            bounds: Lower and upper corner [m, F], shape (2, 3), outside of which the density is taken as
                zero.
            framework: "jax", "numpy" or "torch"; None finds out by trying.
            step: Step [m] of central differences for a NumPy function; None means 1e-4 of the largest extent
                of the bounds, which suits functions computed in float64.

        Raises:
            ValueError: If the bounds are not ordered, the framework is not known or not found, or the
                function fails or returns a wrong shape, NaN, infinities or negative densities.
        """
        self.box = checked_bounds(bounds)
        if not callable(function):
            raise ValueError(f"function must be callable, (n, 3) -> (n,), got {type(function).__name__}")
        if framework not in (None, "jax", "numpy", "torch"):
            raise ValueError(f"framework must be 'jax', 'numpy', 'torch' or None, got {framework!r}")
        extent = _finite_box(self.box)
        usual = 1e-4 * float(np.max(extent[1] - extent[0]))
        self.step = usual if step is None else checked_number("step", step, above=0)
        self.framework = _probe(function, framework, extent)
        is_module = self.framework == "jax" and isinstance(function, eqx.Module)
        self.module = function if is_module else None
        self.function = None if is_module else function

    @property
    def bounds(self) -> Float[Array, "2 3"]:
        """The box [m, F] given at construction."""
        return self.box

    def density(self, x: Float[Array, "3"]) -> Float[Array, ""]:
        """Density at `x` [m, F], zero outside of the bounds."""
        if self.framework == "jax":
            return self._traced(x[None])[0]
        return self._masked(x, _host_jet(self._host, 0, x)[0])

    def jet(self, x: Float[Array, "3 n"], order: int) -> Jet:
        """See `AbstractField.jet`; one call of the function for the whole batch."""
        check_order(order)
        points = x.T
        if self.framework == "jax":
            if order == 2:
                return vmapped_jet(self.density, x, order)
            if order == 0:
                return self._traced(points)
            value, pull = jax.vjp(self._traced, points)
            # Points do not mix, so the gradient of the sum is the gradient of each.
            return value, pull(jnp.ones_like(value))[0].T
        value, *derivatives = _host_jet(self._host, order, points)
        masked = self._masked(points, value)
        if order == 0:
            return masked
        keep = (masked != 0)[:, None]
        gradient = jnp.where(keep, derivatives[0], 0).T
        if order == 1:
            return masked, gradient
        return masked, gradient, jnp.where(keep[..., None], derivatives[1], 0).transpose(1, 2, 0)

    @property
    def _host(self) -> "_HostFunction":
        return _HostFunction(self._call, self.framework, self.step)

    @property
    def _call(self) -> Callable:
        return self.module if self.function is None else self.function

    def _traced(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        return self._masked(points, self._call(points).astype(points.dtype))

    def _masked(
        self, points: Float[Array, "*batch 3"], value: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        box = jnp.broadcast_to(self.box.astype(points.dtype), (*points.shape[:-1], 2, 3))
        inside = jnp.all((points >= box[..., 0, :]) & (points <= box[..., 1, :]), axis=-1)
        # Written so that NaN stays NaN: a failing function must not pass for empty space.
        return jnp.where(inside, jnp.where(value < 0, 0, value), 0)


def checked_bounds(bounds: Numbers, name: str = "bounds") -> Float[Array, "2 3"]:
    """`bounds` as a floating array; entries may be infinite.

    Raises:
        ValueError: If the shape is not (2, 3), an entry is NaN, or a lower bound is not below its upper
            bound.
    """
    array = checked_floating(name, bounds)
    if array.shape != (2, 3):
        raise ValueError(f"{name} must have shape (2, 3), lower and upper corner [m], got {array.shape}")
    if not is_traced(array):
        host = np.asarray(array)
        if not np.all(host[0] < host[1]):
            raise ValueError(
                f"{name} must have every lower corner below its upper corner, got {host.tolist()}"
            )
    return array


def _finite_box(bounds: Float[Array, "2 3"]) -> np.ndarray:
    """The bounds with infinite entries replaced by one metre from the other side (or from the origin)."""
    lower, upper = np.asarray(bounds, dtype=np.float64)
    lower = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 1, -1))
    return np.stack([lower, np.where(np.isfinite(upper), upper, lower + 1)])


class _HostFunction:
    """A NumPy or PyTorch function with its derivatives; equal and hashed by its parts, for JAX's caches."""

    def __init__(self, function: Callable, framework: Framework, step: float):
        self.parts = (function, framework, step)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _HostFunction) and self.parts == other.parts

    def __hash__(self) -> int:
        return hash(self.parts)

    def jet(self, order: int, x: ArrayLike) -> tuple[np.ndarray, ...]:
        """φ and its derivatives up to `order` at points (..., 3): shapes (...), (..., 3), (..., 3, 3)."""
        function, framework, step = self.parts
        x = np.asarray(x)
        points = x.reshape(-1, 3).astype(np.float64)
        jet = (
            _torch_jet(function, points, order)
            if framework == "torch"
            else _numpy_jet(function, points, order, step)
        )
        batch = x.shape[:-1]
        return tuple(part.reshape(batch + part.shape[1:]).astype(x.dtype) for part in jet)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _host_jet(host: _HostFunction, order: int, x: Float[Array, "*batch 3"]) -> tuple[Array, ...]:
    """Jet of a host function; vmapped calls reach it as one batch."""
    if not is_traced(x):
        return tuple(jnp.asarray(part) for part in host.jet(order, x))

    def shapes(x: Array) -> tuple[jax.ShapeDtypeStruct, ...]:
        return tuple(jax.ShapeDtypeStruct(x.shape[:-1] + (3,) * rank, x.dtype) for rank in range(order + 1))

    return batched_callback(functools.partial(host.jet, order), shapes, x)


@_host_jet.defjvp
def _host_jet_jvp(
    host: _HostFunction, order: int, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    if order >= 2:
        raise NotImplementedError(
            "NumPy and PyTorch densities have no third derivatives: bake the field, or write it in JAX"
        )
    jet = _host_jet(host, order + 1, *primals)
    (dx,) = tangents
    along = tuple(
        jnp.sum(part * jnp.expand_dims(dx, tuple(range(dx.ndim - 1, part.ndim - 1))), axis=-1)
        for part in jet[1:]
    )
    return jet[:-1], along


def _numpy_jet(function: Callable, points: np.ndarray, order: int, step: float) -> tuple[np.ndarray, ...]:
    """Central differences from one call: 1, 7 or 19 evaluations a point."""
    axes = step * np.eye(3)
    offsets = [np.zeros(3)]
    if order >= 1:
        offsets += [sign * axes[i] for i in range(3) for sign in (1, -1)]
    pairs = [(0, 1), (0, 2), (1, 2)]
    if order >= 2:
        offsets += [s * axes[i] + t * axes[j] for i, j in pairs for s in (1, -1) for t in (1, -1)]
    stencil = (points[None] + np.stack(offsets)[:, None]).reshape(-1, 3)
    values = np.asarray(function(stencil), dtype=np.float64).reshape(len(offsets), len(points))
    if order == 0:
        return (values[0],)
    plus, minus = values[1:7:2], values[2:7:2]
    gradient = ((plus - minus) / (2 * step)).T
    if order == 1:
        return values[0], gradient
    hessian = np.empty((len(points), 3, 3))
    for i in range(3):
        hessian[:, i, i] = (plus[i] - 2 * values[0] + minus[i]) / step**2
    for (i, j), (pp, pm, mp, mm) in zip(pairs, values[7:].reshape(3, 4, -1), strict=True):
        hessian[:, i, j] = hessian[:, j, i] = (pp - pm - mp + mm) / (4 * step**2)
    return values[0], gradient, hessian


def _torch_jet(function: Callable, points: np.ndarray, order: int) -> tuple[np.ndarray, ...]:
    """Values and derivatives by torch's autograd."""
    import torch  # pyright: ignore[reportMissingImports]

    x = _torch_points(function, points)
    if order == 0:
        with torch.no_grad():
            return (function(x).cpu().numpy(),)
    x.requires_grad_()

    def gradient_of(total: "torch.Tensor") -> "torch.Tensor":
        # A function that is constant, or whose gradient is, is not connected to x: its derivative is zero.
        if not total.requires_grad:
            return torch.zeros_like(x)
        (result,) = torch.autograd.grad(
            total, x, create_graph=order == 2, allow_unused=True, retain_graph=True
        )
        return torch.zeros_like(x) if result is None else result

    value = function(x)
    gradient = gradient_of(value.sum())
    jet = [value, gradient]
    if order == 2:
        jet.append(torch.stack([gradient_of(gradient[:, i].sum()) for i in range(3)], dim=1))
    return tuple(part.detach().cpu().numpy() for part in jet)


def _torch_points(function: Callable, points: np.ndarray) -> Any:
    """Points as a tensor of the dtype and on the device of the function's parameters, if it has any."""
    import torch  # pyright: ignore[reportMissingImports]

    parameters = getattr(function, "parameters", None) if isinstance(function, torch.nn.Module) else None
    parameter = None if parameters is None else next(parameters(), None)
    dtype = torch.get_default_dtype() if parameter is None else parameter.dtype
    return torch.as_tensor(points).to(dtype=dtype, device=None if parameter is None else parameter.device)


def _probe(function: Callable, framework: Framework | None, box: np.ndarray) -> Framework:
    """The framework of `function`, after checking what it returns at random points of `box`."""
    points = np.random.default_rng(0).uniform(box[0], box[1], (_N_PROBES, 3))
    errors = {}
    for candidate in (framework,) if framework else _candidates(function):
        try:
            values = _try(function, candidate, points)
        except Exception as error:  # whatever a user's function raises is the message
            errors[candidate] = error
            continue
        _check_probe(values)
        return candidate
    tried = "; ".join(
        f"as {name}: {type(e).__name__}: {str(e).splitlines()[0] if str(e) else ''}"
        for name, e in errors.items()
    )
    raise ValueError(
        f"function must map points (n, 3) to densities (n,), but failed on {_N_PROBES} points ({tried})"
    ) from next(iter(errors.values()))


def _candidates(function: Callable) -> tuple[Framework, ...]:
    torch = sys.modules.get("torch")
    if torch is None:
        return ("jax", "numpy")
    return ("torch",) if isinstance(function, torch.nn.Module) else ("jax", "numpy", "torch")


def _try(function: Callable, framework: Framework, points: np.ndarray) -> np.ndarray:
    if framework == "jax":
        # Traced, as it will be used: NumPy calls inside fail here.
        return np.asarray(
            jax.jit(lambda x: jnp.asarray(function(x)))(jnp.asarray(points, jnp.result_type(float)))
        )
    if framework == "numpy":
        values = function(points)
        if isinstance(values, jax.Array):
            raise TypeError("it returned a JAX array, but could not be traced by JAX")
        return np.asarray(values, dtype=np.float64)
    values = function(_torch_points(function, points))
    return values.detach().cpu().numpy()


def _check_probe(values: np.ndarray) -> None:
    if values.shape != (_N_PROBES,):
        raise ValueError(
            f"function must return shape ({_N_PROBES},) for points ({_N_PROBES}, 3), got {values.shape}"
        )
    if not np.all(np.isfinite(values)):
        raise ValueError(
            f"function must return finite densities, got {np.sum(~np.isfinite(values))} NaN or infinite at"
            f" {_N_PROBES} random points inside the bounds"
        )
    if values.min() < 0:
        raise ValueError(
            f"function must return densities ≥ 0, got {values.min()} inside the bounds (a signed distance"
            " is not a density: sample it into a SignedDistanceGrid)"
        )
