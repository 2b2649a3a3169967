"""`python -m benchmarks.plan [--json FILE] [--quick] [--cases N] [--goals N] [--only-goals] [--baseline]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.plan._run import run  # imports JAX, so not before

    run()
