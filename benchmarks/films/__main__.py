"""`python -m benchmarks.films DIR [--rendered DIR] [--only FILM …] [--json FILE] [--quick]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.films._run import run  # imports JAX, so not before

    run()
