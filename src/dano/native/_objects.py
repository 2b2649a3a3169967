"""Compiled kernels: those that come with dano, those kept on this machine, or new ones.

For CPUs an object of a module lies beside the layouts of its kernels. It is loaded by the library of Warp's
compiler, which needs neither Warp's Python code, which takes a second to import, nor the modules of kernels,
which take another to run. Both are asked for only where an object has to be made. For NVIDIA's GPUs machine
code comes with dano, made on machines without one.
"""

import concurrent.futures
import ctypes
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dano.caches import cache_folder, cache_place
from dano.native._instances import Features, instance, modules_behind, source_of
from dano.native._layout import ArrayField, Layout, layout_of, NumberField, Parameters
from dano.native._warp import begin, compile_object, compiled_kernel, FLAGS

SHIPPED = Path(__file__).parents[1] / "compiled"
"""Folder of the objects that come with dano, a folder for each level of processors."""
LEVELS = {
    "x86-64-v4": frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    "x86-64-v3": frozenset({"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"}),
}
"""Levels of processors for which objects are made, the best first, and the features that each adds (x86-64
psABI). Names are LLVM's."""
_LIBRARIES = {"linux": ("warp.so", "warp-clang.so"), "darwin": ("libwarp.dylib", "libwarp-clang.dylib")}


class Kernel(NamedTuple):
    """A kernel that can be called."""

    layout: Layout  # Of its parameters
    call: Any  # From the addresses of bounds and parameters
    address: int  # Of the function itself


class Bounds(ctypes.Structure):
    """How large a launch is: Warp's `launch_bounds_t` of one axis or two, whose sizes stand in one place."""

    _fields_ = (("shape", ctypes.c_uint32 * 2), ("size", ctypes.c_size_t), ("factor", ctypes.c_size_t))

    @classmethod
    def of(cls, count: int) -> "Bounds":
        """Those of a launch of so many worlds of one lane, or of whatever else a kernel counts."""
        return cls((ctypes.c_uint32 * 2)(count, 1), count, 1)


class KernelLaunch:
    """A launch of a kernel with parameters of its own."""

    def __init__(self, kernel: Kernel, parameters: Parameters, count: int):
        """Make it.

        Args:
            kernel: The kernel.
            parameters: What it reads.
            count: How many worlds, or whatever else it counts.
        """
        self.kernel, self.parameters, self.bounds = kernel, parameters, Bounds.of(count)
        self._call, self._given = kernel.call, (ctypes.addressof(self.bounds), parameters.address)

    def __call__(self) -> None:
        """Launch."""
        self._call(*self._given)


@functools.cache
def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def together(works: Sequence[Callable[[], object]]) -> None:
    """Do some works that leave Python's lock, the first of them in this thread; returns when all are done."""
    others = [_workers().submit(work) for work in works[1:]]
    works[0]()
    for other in others:
        other.result()


@functools.cache
def _workers() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(max(1, n_cores() - 1), thread_name_prefix="dano")


# One thread makes objects at a time: Warp's code and Python's parser are for one.
_loading = threading.Lock()
_loaded: dict[tuple[Features, str], tuple[bytes, dict[str, Layout]]] = {}
_numbers = iter(range(10**12))


def cpu_kernel(features: Features, module: str, name: str, *, what: str = "the simulator") -> Kernel:
    """A kernel for this processor, loaded, and compiled before where nobody has.

    Args:
        features: What it must know.
        module: Its module.
        name: Its name.
        what: What it is, for who waits.

    Raises:
        OSError: If it has to be compiled and cannot be.
    """
    handle, layouts = _module(features, module, what)
    layout = layouts[name]
    address = _library().wp_lookup(handle, layout.symbol.encode())
    return Kernel(layout, ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(address), address)


def _module(features: Features, module: str, what: str) -> tuple[bytes, dict[str, Layout]]:
    """A module in this process: its handle, and layouts of its kernels."""
    with _loading:
        if (features, module) not in _loaded:
            _loaded[features, module] = _found_or_made(features, module, what)
        return _loaded[features, module]


def _found_or_made(features: Features, module: str, what: str) -> tuple[bytes, dict[str, Layout]]:
    for path in _places(features, module):
        found = _read(path, fingerprint(features, module))
        if found is not None and (handle := _load(_object(path))) is not None:
            return handle, found
    folder = cache_folder()
    # Without a cache an object is there until the process ends, which needs it no longer than it is loaded.
    with tempfile.TemporaryDirectory(prefix="dano-kernels-") as unkept:
        path = kept_path(features, module, Path(unkept) if folder is None else folder / "kernels")
        layouts = make_object(features, module, path, FLAGS, what)
        handle = _load(_object(path))
        if handle is None:
            raise OSError(f"{what} was compiled into {path.with_suffix('.o')}, which cannot be loaded")
        return handle, layouts


def _places(features: Features, module: str) -> Iterator[Path]:
    """Where an object of a module may lie, the best first."""
    yield from (shipped_path(features, module, level) for level in levels())
    # What is there is read, also where nothing can be written.
    place = cache_place()
    if place is not None:
        yield kept_path(features, module, place / "kernels")


def shipped_path(features: Features, module: str, level: str) -> Path:
    """Where an object that comes with dano lies, without its ending."""
    return SHIPPED / level / file_name(features, module)


def what_is_shipped(features: Features, module: str, level: str) -> dict[str, Layout] | None:
    """Layouts of what comes with dano for a level of processors; None if it is not there, or out of date."""
    return _read(shipped_path(features, module, level), fingerprint(features, module))


def kept_path(features: Features, module: str, folder: Path) -> Path:
    """Where an object for this machine lies in a folder, without its ending."""
    own = hashlib.sha256(f"{sorted(processor_features())} {fingerprint(features, module)}".encode())
    return folder / f"{file_name(features, module)}-{own.hexdigest()[:12]}"


def file_name(features: Features, module: str) -> str:
    """Name of the files of a module."""
    return f"{module.removeprefix('dano.')}.{features.name}"


@functools.cache
def fingerprint(features: Features, module: str) -> str:
    """Of all that an object is made from: sources, features, Warp and its options."""
    found = hashlib.sha256()
    law = dict(features.values).get("LAW")
    own = [Path(law).read_text(encoding="utf-8")] if law else []
    # What lies beside an object is written by another module.
    texts = (source_of(name) for name in (*modules_behind(module), "dano.native._layout"))
    for text in (importlib.metadata.version("warp-lang"), FLAGS, features.name, *texts, *own):
        found.update(f"{len(text)} {text}".encode())
    return found.hexdigest()


def make_object(
    features: Features, module: str, path: Path, flags: str, what: str = "the simulator"
) -> dict[str, Layout]:
    """Compile a module into an object; returns the layouts of its kernels.

    Args:
        features: What it must know.
        module: Its name.
        path: Of its files, without their ending.
        flags: Of Warp's compiler.
        what: What it is, for who waits.

    Raises:
        OSError: If the files cannot be written.
    """
    import warp as wp

    def kernels() -> list[Any]:
        return [x for x in vars(instance(features, module)).values() if isinstance(x, wp.Kernel)]

    layouts = {}

    def made() -> Any:
        found = kernels()
        layouts.update({kernel.key: layout_of(kernel) for kernel in found})
        return found[0].module

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".making-", dir=path.parent) as folder:
            compiled = compile_object(made, Path(folder), flags, what=what)
            # The object first: what reads layouts finds it there.
            os.replace(compiled, _object(path))
            content = {"fingerprint": fingerprint(features, module), "kernels": layouts}
            written = Path(folder, "layouts")
            written.write_text(json.dumps(content), encoding="utf-8")
            os.replace(written, _layouts(path))
    except OSError as error:
        raise OSError(
            f"{what} cannot be compiled in {path.parent}: {error}; DANO_CACHE_DIR names another folder"
        ) from error
    return layouts


def _object(path: Path) -> Path:
    return path.with_name(f"{path.name}.o")


def _layouts(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _read(path: Path, wanted: str) -> dict[str, Layout] | None:
    """Layouts beside an object; None if there are none, or it was made from something else."""
    try:
        content = json.loads(_layouts(path).read_text(encoding="utf-8"))
        if content["fingerprint"] != wanted:
            return None
        return {name: _layout(*fields) for name, fields in content["kernels"].items()}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _layout(symbol: str, arguments: dict, arrays: dict, numbers: dict, size: int) -> Layout:
    return Layout(
        symbol,
        {name: tuple(field) for name, field in arguments.items()},
        {place: ArrayField(*field) for place, field in arrays.items()},
        {place: NumberField(*field) for place, field in numbers.items()},
        size,
    )


def _load(path: Path) -> bytes | None:
    """Handle of an object in this process; None if it cannot be loaded."""
    handle = f"dano_{next(_numbers)}".encode()
    if not path.is_file() or _library().wp_load_obj(os.fsencode(path), handle, False) != 0:
        return None
    return handle


@functools.cache
def _library() -> Any:
    """The library of Warp's compiler.

    Raises:
        OSError: If Warp has none here.
    """
    spec = importlib.util.find_spec("warp")
    assert spec is not None and spec.submodule_search_locations is not None
    folder = Path(spec.submodule_search_locations[0], "bin")
    core_name, name = _LIBRARIES.get(sys.platform, ("warp.dll", "warp-clang.dll"))
    core, library = ctypes.CDLL(str(folder / core_name)), ctypes.CDLL(str(folder / name))
    # Lanes of a CPU that take turns are switched by the other library.
    core.wp_cpu_block_runtime_get_api.restype = ctypes.c_void_p
    library.wp_llvm_set_cpu_block_runtime.argtypes = [ctypes.c_void_p]
    library.wp_llvm_set_cpu_block_runtime(core.wp_cpu_block_runtime_get_api())
    library.wp_load_obj.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_bool]
    library.wp_lookup.argtypes = [ctypes.c_char_p, ctypes.c_char_p]
    library.wp_lookup.restype = ctypes.c_uint64
    library.wp_get_host_cpu_features.restype = ctypes.c_char_p
    return library


@functools.cache
def processor_features() -> frozenset[str]:
    """Features of this processor, by LLVM's names."""
    listed = (_library().wp_get_host_cpu_features() or b"").decode().split(",")
    return frozenset(
        {platform.machine(), *(name.removeprefix("+") for name in listed if not name.startswith("-"))}
    )


def levels() -> list[str]:
    """Levels of processors whose objects run here, the best first."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return []
    has, needed = processor_features(), frozenset()
    found = []
    for level, features in reversed(LEVELS.items()):
        needed |= features
        if needed <= has:
            found.insert(0, level)
    return found


ARCHITECTURES = (80, 90, 100, 120)
"""Architectures for which machine code is made (compute capability times ten). It runs on those of the same
generation that came later, too."""


def make_cubin(features: Features, module: str, architecture: int) -> Path:
    """Compile a module for a GPU; what is there already and fits stays.

    Args:
        features: What it must know, with its lanes.
        module: Its name.
        architecture: Of the GPU.
    """
    import warp as wp

    folder, stated = _cubin_places(features, module, architecture)
    if not _fits(stated, features, module):
        begin()
        made = _prepared(_module_of(features, module), features)
        folder.mkdir(parents=True, exist_ok=True)
        wp.compile_aot_module(made, arch=architecture, module_dir=folder, use_ptx=False, strip_hash=True)
        with tempfile.TemporaryDirectory(dir=folder) as unfinished:
            written = Path(unfinished, "fingerprint")
            written.write_text(json.dumps({"fingerprint": fingerprint(features, module)}), encoding="utf-8")
            os.replace(written, stated)
    return stated


def kernel_in_lanes(features: Features, module: str, name: str, device: str) -> Any:
    """A kernel of Warp's for worlds of several lanes, loaded, and compiled before where nobody has.

    Args:
        features: What it must know, with its lanes.
        module: Its module.
        name: Its name.
        device: Where it runs, as Warp calls it.
    """
    import warp as wp

    begin()
    kernel = getattr(instance(features, module), name)
    on = wp.get_device(device)
    for architecture in architectures_for(on.arch) if on.is_cuda else ():
        folder, stated = _cubin_places(features, module, architecture)
        if _fits(stated, features, module):
            made = _prepared(kernel.module, features)
            wp.load_aot_module(made, on, architecture, folder, use_ptx=False, strip_hash=True)
            return kernel
    return compiled_kernel(lambda: kernel, device, dict(features.values)["LANES"])


def architectures_for(architecture: int) -> list[int]:
    """Those whose machine code runs on a GPU, the best first: of its generation, not younger."""
    same = (x for x in ARCHITECTURES if x // 10 == architecture // 10 and x <= architecture)
    return sorted(same, reverse=True)


def _module_of(features: Features, module: str) -> Any:
    import warp as wp

    return next(x for x in vars(instance(features, module)).values() if isinstance(x, wp.Kernel)).module


def _prepared(module: Any, features: Features) -> Any:
    module.options["block_dim"] = dict(features.values)["LANES"]
    module.options["cuda_output"] = "cubin"
    return module


def _cubin_places(features: Features, module: str, architecture: int) -> tuple[Path, Path]:
    """Folder of machine code, and the file that states what it was made from."""
    folder = SHIPPED / f"sm_{architecture}"
    return folder, folder / f"{file_name(features, module)}.json"


def _fits(stated: Path, features: Features, module: str) -> bool:
    try:
        content = json.loads(stated.read_text(encoding="utf-8"))
        return content["fingerprint"] == fingerprint(features, module)
    except (OSError, ValueError, KeyError, TypeError):
        return False
