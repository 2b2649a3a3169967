"""Kernels that find contacts of neural objects in a MuJoCo model, around the formulas of `dano.physics`."""
