"""`python -m benchmarks.gpu [--compile NAME] [--worlds N] [--steps N] [--json FILE]`; see gpu.sh."""

import os

from benchmarks import _environment

if __name__ == "__main__":
    # Both machines in one process: results are compared.
    os.environ.setdefault("JAX_PLATFORMS", "cuda,cpu")
    _environment.use_float64()
    from benchmarks.gpu._run import run  # imports JAX, so not before

    run()
