"""`python -m benchmarks.robots.push [--json FILE] [--quick]`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    _environment.pin_to_one_core()
    from benchmarks.robots.push._run import run  # imports JAX, so not before

    run()
