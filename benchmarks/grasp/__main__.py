"""`python -m benchmarks.grasp [--json FILE] [--quick] [--cases N]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.grasp._run import run  # imports JAX, so not before

    run()
