"""Machine code for NVIDIA's GPUs that comes with dano: made on machines without one."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from dano.native._instances import Features, instance
from dano.native._objects import file_name, fingerprint, SHIPPED
from dano.native._warp import begin, compiled_kernel

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

    folder, stated = _places(features, module, architecture)
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
        folder, stated = _places(features, module, architecture)
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


def _places(features: Features, module: str, architecture: int) -> tuple[Path, Path]:
    """Folder of machine code, and the file that states what it was made from."""
    folder = SHIPPED / f"sm_{architecture}"
    return folder, folder / f"{file_name(features, module)}.json"


def _fits(stated: Path, features: Features, module: str) -> bool:
    try:
        content = json.loads(stated.read_text(encoding="utf-8"))
        return content["fingerprint"] == fingerprint(features, module)
    except (OSError, ValueError, KeyError, TypeError):
        return False
