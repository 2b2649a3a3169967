"""Objects in many worlds at once, in MuJoCo Warp and Newton: python -m benchmarks.worlds."""
