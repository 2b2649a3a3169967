"""`python -m benchmarks.paper.learn [--cases NAME …] [--keep DIR] [--json FILE] [--quick]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.paper.learn._run import run  # imports JAX, so not before

    run()
