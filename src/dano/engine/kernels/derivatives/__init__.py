"""Derivatives of rollouts in both modes, by `wp.grad` of the formulas of a step (docs/gradients.md).

At the root of R(V; θ) = 0 the implicit function theorem gives θ̄ = −(∂R/∂θ)ᵀ λ with (∂R/∂V)ᵀ λ = V̄. So
with λ as *virtual velocities* of the bodies, −λ · R is the work of impulses along them: a sum over bodies
and points. Each term is a function made of the formulas of the step itself, and `wp.grad` differentiates it;
these functions stand first in their files.

What a function reads of an array whose `grad` points somewhere, Warp adds the derivative to by itself: by
`Room.given` to `Room.bars`, by `Room.bodies` to `Room.body_bars`. That is for what few lanes do; what many
samples depend on is a structure by value, whose derivatives are summed before they are added.
"""
