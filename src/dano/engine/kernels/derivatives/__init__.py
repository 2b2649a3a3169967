"""Derivatives of rollouts in both modes, by `wp.grad` of the formulas of a step at its solution."""
