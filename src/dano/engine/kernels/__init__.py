"""Loops around the formulas of `dano.physics`, in NVIDIA Warp. Importing this package imports Warp."""
