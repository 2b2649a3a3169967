"""How kernels are compiled, and when what was compiled before still holds."""

import hashlib
from pathlib import Path

import numba

# Called from other kernels only, so without wrappers for Python, which take a third of the time to compile;
# division by zero gives infinities and NaNs, as in XLA. Only handlers are kept on disk, whole: Numba compiles
# a kernel again when its own file changes, but not when one that it calls does.
kernel = numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
# Without the counts of who refers to an array, which cost more than small kernels do, at run time and to
# compile. Such a kernel makes no arrays, and returns none that were made.
lean = numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)


def fingerprint() -> int:
    """A number for the sources of all kernels: as a closure of a handler it is part of the key on disk."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return int.from_bytes(digest.digest()[:7])
