"""Kernels on an NVIDIA GPU: the same as on a CPU, and how fast."""
