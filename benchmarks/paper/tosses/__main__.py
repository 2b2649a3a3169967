"""The measured tosses; see `--help`.

`python -m benchmarks.paper.tosses [--data FILE] [--params FILE] [--json FILE] [--picture FILE] [--quick]
[--tune [SECONDS]]`
"""

from benchmarks import _environment

if __name__ == "__main__":
    _environment.use_float64_on_cpu()
    from benchmarks.paper.tosses._run import run  # imports JAX, so not before

    run()
