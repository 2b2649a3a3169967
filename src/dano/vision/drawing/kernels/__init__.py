"""Kernels that draw, run with the features that they need: see `dano.native`."""
