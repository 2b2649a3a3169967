"""`python -m benchmarks.bridge [NAME …] [--json FILE] [--quick]`."""

import os

if __name__ == "__main__":
    os.environ["JAX_ENABLE_X64"] = "1"
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    # One core, as a user's control loop has.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from benchmarks.bridge._run import run  # imports NumPy and JAX, so not before

    run()
