"""Settings and data shared by all tests."""

import contextlib
import ctypes
import gc
import os
from importlib.metadata import version
from pathlib import Path

# Compiling is most of a test's time. XLA's newer code generator for fused operations takes twice as long as
# the one before, and simulations run no faster with it. It is read when JAX makes its backend. From jaxlib
# 0.11 on there is only the newer one, and XLA ends the process at a flag that it does not know.
if tuple(int(n) for n in version("jaxlib").split(".")[:2]) < (0, 11):
    FAST_COMPILING = "--xla_cpu_use_fusion_emitters=false"
    os.environ["XLA_FLAGS"] = f"{FAST_COMPILING} {os.environ.get('XLA_FLAGS', '')}".strip()

import equinox as eqx
import jax
import pytest
from jaxtyping import install_import_hook

# The library follows its inputs' dtype. Tests compare in float64 and let no silent cast or broadcast pass.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# A program that XLA compiles stays mapped while JAX keeps it, and Linux allows 65,530 maps a process.
MANY_MAPS = 15_000
MUCH_MEMORY = 1.2e9
"""Bytes of a process from which compiled programs are forgotten: two run beside each other in 8 GB."""

REPOSITORY = Path(__file__).resolve().parents[1]

# Folders whose programs run longer than they compile (photographs that are rendered, fields), and
# two that compare to the last digits. Compiling takes half as long without optimizing.
RUNS_LONG = ("fields", "objects", "reference_step", "test_assets", "vision")

# Shapes and types are checked while tracing; kernels are compiled by Warp, which takes plain functions only.
COMPILED = ("physics",)
CHECKED = [path.stem for path in (REPOSITORY / "src" / "dano").iterdir() if path.stem not in COMPILED]
install_import_hook([f"dano.{name}" for name in CHECKED], "beartype.beartype")


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Forget compiled programs between modules once there are many; a process that runs out of maps dies."""
    yield
    maps, pages = Path("/proc/self/maps"), Path("/proc/self/statm")
    if not maps.is_file():
        return
    used = int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if used > MUCH_MEMORY or maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
        eqx.clear_caches()
        gc.collect()
        # The C library keeps what was freed, unless it is asked to give it back.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module", autouse=True)
def optimized(request: pytest.FixtureRequest):
    """Whether programs of a module are optimized: see `RUNS_LONG`."""
    name = str(request.path.relative_to(REPOSITORY / "tests"))
    jax.config.update("jax_disable_most_optimizations", not name.startswith(RUNS_LONG))


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the paper's stored trajectories and fields, which are not ours to redistribute."""
    default = REPOSITORY.parent / "shared" / "reference" / "data"
    folder = Path(os.environ.get("DANO_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no reference data in {folder}: set DANO_REFERENCE_DATA to the folder that holds it")
    return folder
