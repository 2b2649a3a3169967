"""Measurements of dano: `python -m benchmarks.speed` and `python -m benchmarks.paper`."""
