"""`python -m benchmarks.gradients [--json FILE] [--quick] [--table toss] [--only FAMILY ...]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.gradients._run import run  # imports JAX, so not before

    run()
