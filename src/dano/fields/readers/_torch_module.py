"""Densities that are code: exported PyTorch modules, and functions and modules by import path."""

import importlib
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dano.extras import optional
from dano.fields._callable import CallableField
from dano.fields.readers._checkpoint import read_weights
from dano.maths import Numbers


def load_module(path: Path, *, crop: Numbers | None, module: str | None = None) -> CallableField:
    """A PyTorch module that maps points (n, 3) to densities (n,).

    Args:
        path: A file of torch.export (.pt2) or TorchScript; or weights, a state dictionary for the module
            that `module` makes.
        crop: Box [units of the module] outside of which the density is zero; required.
        module: "package.module:name" of a class or function that makes a torch.nn.Module without arguments.
            It is imported, and so runs: name only code that you trust.

    Raises:
        ValueError: If `crop` is missing, the file is neither, its weights do not fit, or the module does not
            map points to densities.
        ImportError: If torch is missing or `module` cannot be imported.
    """
    bounds = _required(crop, path)
    torch = _torch()
    if module is None:
        try:
            if path.suffix.lower() == ".pt2":
                made = torch.export.load(str(path)).module()
            else:
                with warnings.catch_warnings():
                    # Of one category or another by version: that torch drops this format says nothing here.
                    warnings.simplefilter("ignore", DeprecationWarning)
                    warnings.simplefilter("ignore", FutureWarning)
                    made = torch.jit.load(str(path), map_location="cpu").eval()
        except (RuntimeError, ValueError, OSError, KeyError, AttributeError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise ValueError(
                f"{path}: expected an exported or TorchScript module, or weights and"
                f" module='package.module:name' that makes their torch.nn.Module; {reason}"
            ) from error
    else:
        made: Any = imported(module)
        made = made if isinstance(made, torch.nn.Module) else made()
        if not isinstance(made, torch.nn.Module):
            raise ValueError(f"module {module!r} must make a torch.nn.Module, got {type(made).__name__}")
        try:
            made.load_state_dict(_state(read_weights(path), made.state_dict(), torch))
        except RuntimeError as error:
            raise ValueError(f"{path}: its weights do not fit {module!r}: {error}") from error
        made.eval()
    try:
        return CallableField(_FlatModule(made, torch), bounds, "torch")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def load_callable(name: str, *, crop: Numbers | None) -> CallableField:
    """A density given by the import path of a function (n, 3) → (n,) of JAX, NumPy or PyTorch.

    Args:
        name: "package.module:name". It is imported, and so runs: name only code that you trust.
        crop: Box outside of which the density is zero; required.

    Raises:
        ValueError: If `crop` is missing or the function does not map points to densities.
        ImportError: If it cannot be imported.
    """
    bounds = _required(crop, name)
    function: Any = imported(name)
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(function, torch.nn.Module):
        function = _FlatModule(function.eval(), torch)
        return CallableField(function, bounds, "torch")
    return CallableField(function, bounds)


def imported(name: str) -> Callable:
    """What "package.module:name" stands for; the current folder counts as on the path.

    Raises:
        ValueError: If it has another form or is not callable.
        ImportError: If the module or the name in it does not exist.
    """
    module, _, attribute = name.partition(":")
    if not (module and attribute):
        raise ValueError(f"module must have the form 'package.module:name', got {name!r}")
    sys.path.insert(0, "")
    try:
        found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except AttributeError as error:
        raise ImportError(f"module {module!r} has no {attribute!r}") from error
    finally:
        sys.path.remove("")
    if not callable(found):
        raise ValueError(f"{name!r} must be callable, got {type(found).__name__}")
    return found


class _FlatModule:
    """A torch module whose output of shape (n, 1) counts as (n,); hands its parameters on."""

    def __init__(self, module: Any, torch: Any):
        self._module = module
        parameter = next(module.parameters(), None)
        self._kind = {} if parameter is None else {"dtype": parameter.dtype, "device": parameter.device}
        self._default = torch.get_default_dtype()

    def __call__(self, x: Any) -> Any:
        out = self._module(x.to(**self._kind) if self._kind else x)
        return out[:, 0] if getattr(out, "ndim", 1) == 2 and out.shape[1] == 1 else out


def _required(crop: Numbers | None, what: object) -> Numbers:
    if crop is None:
        raise ValueError(f"{what}: a function has no bounds of its own: give them as crop")
    return crop


def _torch() -> Any:
    return optional("torch", "PyTorch modules need torch", "torch")


def _state(weights: dict[str, Any], wanted: dict[str, Any], torch: Any) -> dict[str, Any]:
    """Weights under the names of the module; a common prefix such as "state_dict." is dropped."""
    for prefix in sorted(
        {key[: -len(name)] for key in weights for name in wanted if key.endswith(name)}, key=len
    ):
        if all(prefix + name in weights for name in wanted):
            return {name: torch.as_tensor(weights[prefix + name]) for name in wanted}
    return {name: torch.as_tensor(value) for name, value in weights.items()}
