"""`python -m benchmarks.identify [--json FILE] [--quick] [--only KIND] [--fits N] [--starts N] [--plain]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.identify._run import run  # imports JAX, so not before

    run()
