"""How kernels are compiled."""

import numba

# Called from other kernels only, so without wrappers for Python, which take a third of the time to compile;
# division by zero gives infinities and NaNs, as in XLA.
kernel = numba.njit(cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
