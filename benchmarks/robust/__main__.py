"""`python -m benchmarks.robust [--steps N] [--seed S] [--mujoco] [--json FILE] [--quick]`; see `--help`."""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    _environment.pin_to_one_core()
    from benchmarks.robust._run import run  # imports JAX, so not before

    run()
