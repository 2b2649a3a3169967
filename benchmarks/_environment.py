"""Settings that must stand before NumPy and JAX are imported."""

import os
import sys


def use_float64() -> None:
    """Precision of the benchmarks; on a CPU, or where JAX_PLATFORMS says.

    Raises:
        RuntimeError: If JAX is imported already and would not heed them.
    """
    if "jax" in sys.modules:
        raise RuntimeError("JAX is imported before its settings: a package of benchmarks imports it")
    os.environ["JAX_ENABLE_X64"] = "1"
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "0"  # a warm cache would pass for a fast compiler


def use_float64_on_cpu() -> None:
    """The same for what measures the time of processors, so always on a CPU."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    use_float64()


def pin_to_one_core() -> None:
    """Keep this process, and everything that XLA and BLAS start in it, on one core.

    Unpinned, XLA moves work to other threads, and two programs that share a core measure each other.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
