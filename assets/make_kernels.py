"""Compiles the kernels that come with dano, for processors and GPUs that this machine need not have.

`python assets/make_kernels.py [--levels x86-64-v3 …] [--architectures 90 …]` writes into `src/dano/compiled`.
What is there already and was made from the same sources stays.
"""

import argparse
import concurrent.futures
import functools
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path

from dano.engine import launching
from dano.engine.launching import _cuda
from dano.mujoco import _search as bridge
from dano.native import (
    ARCHITECTURES,
    Features,
    FLAGS,
    LEVELS,
    make_cubin,
    make_object,
    shipped_path,
    what_is_shipped,
)
from dano.vision.drawing import _rays as drawing


def main() -> None:
    """Compile what is missing, in as many processes as there are cores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--levels", nargs="*", default=list(LEVELS), choices=LEVELS, help="of processors")
    parser.add_argument(
        "--architectures", nargs="*", default=[], type=int, choices=ARCHITECTURES, help="of GPUs"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    options = parser.parse_args()
    works = [*_for_processors(options.levels), *_for_gpus(options.architectures)]
    begun = time.monotonic()
    # Warp parses its headers once a process.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.jobs, context) as pool:
        for path, seconds in pool.map(_timed, works):
            print(f"{seconds:6.1f} s  {path.parent.name}/{path.name}", flush=True)
    print(f"{len(works)} modules in {time.monotonic() - begun:.0f} s", flush=True)


def _for_processors(levels: list[str]) -> list[Callable[[], Path]]:
    builds = (*launching.kernel_builds(), *bridge.kernel_builds(), *drawing.kernel_builds())
    return [
        functools.partial(_object, features, module, level)
        for level in levels
        for features, module in builds
        if what_is_shipped(features, module, level) is None
    ]


def _object(features: Features, module: str, level: str) -> Path:
    path = shipped_path(features, module, level)
    make_object(features, module, path, FLAGS.replace("-march=native", f"-target-cpu {level}"))
    return path


def _for_gpus(architectures: list[int]) -> list[Callable[[], Path]]:
    return [
        functools.partial(make_cubin, features.but(LANES=_cuda.LANES, WIDE=wide), module, architecture)
        for architecture in architectures
        for features, module in launching.kernel_builds()
        for wide in (True, False)
    ]


def _timed(work: Callable[[], Path]) -> tuple[Path, float]:
    begun = time.monotonic()
    return work(), time.monotonic() - begun


if __name__ == "__main__":
    main()
