"""`python -m benchmarks.impacts [NAME …] [--json FILE] [--quick]`; names are in `_run.PARTS`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    _environment.pin_to_one_core()
    from benchmarks.impacts._run import run  # imports JAX, so not before

    run()
