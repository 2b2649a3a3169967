"""`python -m benchmarks.paper.learn [--cases NAME …] [--keep DIR] [--json FILE] [--quick]`.

It trains on a GPU with JAX_PLATFORMS=cuda.
"""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64()
    from benchmarks.paper.learn._run import run  # imports JAX, so not before

    run()
