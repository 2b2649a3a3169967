"""Solvers that know nothing of physics: bounded least squares."""

from dano.solvers._least_squares import (
    bounded_least_squares as bounded_least_squares,
    eliminated as eliminated,
    NormalEquations as NormalEquations,
    Solution as Solution,
    Stop as Stop,
)
