"""`python -m benchmarks.paper.rest [--json FILE] [--objects DIR] [--film DIR] [--quick]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.paper.rest._run import run  # imports JAX, so not before

    run()
