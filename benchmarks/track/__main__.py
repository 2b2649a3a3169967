"""`python -m benchmarks.track --films DIR [--masks given object] [--starts 20] [--json FILE] [--quick]`.

`--phone DIR [--only FILM …] [--held] [--friction]` measures with films as phones take them.
"""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.track._run import run  # imports JAX, so not before

    run()
