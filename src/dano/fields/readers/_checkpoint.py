"""Weights of PyTorch's files as NumPy arrays: without torch, and without running what a pickle may hold."""

import math
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dano.memory import in_bytes, memory_limit

_DTYPES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": jnp.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}

_BROKEN = (
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
    OverflowError,
)
"""What damaged pickles and zip files raise."""


def read_weights(path: Path) -> dict[str, np.ndarray]:
    """The tensors of a PyTorch checkpoint, under their place in it: "pipeline._model.field.aabb".

    Only containers, numbers and tensors are made; everything else that the pickle names (optimisers, user's
    classes, functions) becomes an inert placeholder, so that no code of the file runs.

    Args:
        path: A file of `torch.save` (the zip form of torch ≥ 1.6).

    Raises:
        ValueError: If the file is no such zip, is damaged, or holds no tensor.
    """
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError(
                "it is not a zip, or cut off (files of torch before 1.6 must be saved again with a newer one)"
            )
        with zipfile.ZipFile(path) as archive:
            if (size := sum(info.file_size for info in archive.infolist())) > memory_limit():
                raise ValueError(
                    f"it unfolds into {in_bytes(size)}; at most {in_bytes(memory_limit())} are read on this"
                    " machine"
                )
            names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
            if any(name.endswith("/constants.pkl") for name in archive.namelist()):
                raise ValueError("it is a TorchScript module, not a table of weights")
            if len(names) != 1:
                raise ValueError("it has no member data.pkl")
            with archive.open(names[0]) as file:
                content = _Unpickler(file, archive, names[0].removesuffix("data.pkl")).load()
    except _BROKEN as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: expected a PyTorch checkpoint; {reason}") from error
    weights: dict[str, np.ndarray] = {}
    _collect(content, "", weights, set())
    if not weights:
        raise ValueError(f"{path}: expected a PyTorch checkpoint; it holds no tensor")
    return weights


class _Placeholder:
    """Stands for whatever a checkpoint names beyond tensors; takes every construction and does nothing."""

    def __new__(cls, *_: Any, **__: Any) -> "_Placeholder":
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> "_Placeholder":
        return self

    def __setstate__(self, _: Any) -> None:
        pass

    def __setitem__(self, *_: Any) -> None:
        pass

    def __hash__(self) -> int:
        return id(self)

    def append(self, _: Any) -> None:
        pass

    def extend(self, _: Any) -> None:
        pass

    def add(self, _: Any) -> None:
        pass


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: Any, archive: zipfile.ZipFile, folder: str):
        super().__init__(file, encoding="utf-8")
        self._archive, self._folder = archive, folder
        self._storages: dict[str, np.ndarray] = {}

    def find_class(self, module: str, name: str) -> Any:
        allowed: dict[tuple[str, str], Any] = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor"): _tensor,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): lambda data, *_: data,
            ("torch._utils", "_rebuild_parameter_with_state"): lambda data, *_: data,
        }
        if module in ("torch", "torch.storage") and name in _DTYPES:
            return np.dtype(_DTYPES[name])
        return allowed.get((module, name), _Placeholder)

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, np.dtype):
            raise ValueError(f"it has a storage of a kind that cannot be read: {kind!r}")
        if key not in self._storages:
            data = self._archive.read(f"{self._folder}data/{key}")
            if len(data) != count * dtype.itemsize:
                raise ValueError(f"its storage {key} has {len(data)} bytes for {count} numbers")
            self._storages[key] = np.frombuffer(data, dtype)
        return self._storages[key]


def _tensor(
    storage: np.ndarray, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any
) -> np.ndarray:
    """A tensor's view of its storage, as a copy that keeps within it."""
    last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
    if offset < 0 or min((*shape, *strides, 0)) < 0 or (math.prod(shape) and last >= len(storage)):
        raise ValueError(f"it has a tensor {shape} that reaches beyond its storage of {len(storage)} numbers")
    steps = tuple(stride * storage.itemsize for stride in strides)
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps).copy()


def _collect(content: Any, prefix: str, weights: dict[str, np.ndarray], seen: set[int]) -> None:
    """Flatten nested dictionaries into `weights`; what is neither one nor a tensor is left out."""
    if isinstance(content, np.ndarray):
        weights[prefix] = content
    elif isinstance(content, dict) and id(content) not in seen:
        seen.add(id(content))
        for name, value in content.items():
            _collect(value, f"{prefix}.{name}" if prefix else str(name), weights, seen)
