"""`python -m benchmarks.real [NAME …] [--held FOLDER] [--picture FOLDER] [--json FILE] [--quick]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.real._run import run  # imports JAX, so not before

    run()
