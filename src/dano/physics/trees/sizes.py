"""Numbers of the laws of joints, apart from their kernels: messages say them too, and load no compiler."""

STICKS = 1e-7
"""Speed [rad/s or m/s] at which friction has its full size: joints that stick creep by no more."""
STOPS = 1e4
"""How much stiffer a limit is than the effective mass over h².

With an acceleration a, a coordinate ends a h² times the inverse of this beyond its limit.
"""
CLOSES = 1.0
"""Largest speed [rad/s or m/s] at which a limit takes back a coordinate that is beyond it.

One step would do that in a single timestep, at hundreds of rad/s. A coordinate that meets its limit in a
motion stays closer to it than a step at this speed.
"""
