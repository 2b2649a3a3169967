"""What momenta of steps are made of, and constants of their solve, in machine code."""

import math

import numpy as np

from dano.native._compiling import lean

# Rules: constants that `dano.engine` states, in the order of its `RULES`.
WHOLE, GROWS, SHRINKS, LEAST, FIT, SOFT_TOLERANCE, ENOUGH, GIVE_UP, RESOLVED, FADE = range(10)
MIX, RENEWED = 10, 11


@lean
def root(x):
    """Square root of a positive number; of a complex one to first order in its small imaginary part."""
    size = math.sqrt(x.real)
    return size + (x - x.real) * (0.5 / size)


@lean
def shares(squared, resolved, fade):
    """m, m′/x, g and g′/x of `dano.engine._rigid` at x² = (h |ω|/2)²."""
    if squared.real <= resolved * resolved:
        cosine = root(1.0 - squared)
        return cosine, -1.0 / cosine, 1.0, 0.0
    cosine = math.sqrt(1.0 - resolved * resolved)
    first_slope = cosine - resolved * resolved / cosine
    x = root(squared)
    y = x - resolved
    fading = np.exp(-y / fade)
    product = resolved * cosine + y - (1.0 - first_slope) * fade * (1.0 - fading)
    slope = 1.0 - (1.0 - first_slope) * fading
    torque = np.exp(-((y / fade) ** 2))
    return product / x, (slope - product / x) / squared, torque, -2.0 * y / (fade * fade * x) * torque
