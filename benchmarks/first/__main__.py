"""`python -m benchmarks.first [--examples] [--only WORD …] [--json FILE] [--quick]`."""

from benchmarks.first._run import run

if __name__ == "__main__":
    run()
