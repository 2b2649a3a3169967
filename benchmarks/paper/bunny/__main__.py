"""`python -m benchmarks.paper.bunny [--json FILE] [--quick] [--sets N] [--jobs N] [--keep FILE]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.paper.bunny._run import run  # imports JAX, so not before

    run()
