"""Solvers that know nothing of physics: bounded least squares, and optimal trajectories."""

from dano.solvers._augmented import optimal_trajectory as optimal_trajectory
from dano.solvers._least_squares import (
    bounded_least_squares as bounded_least_squares,
    box_minimum as box_minimum,
    BoxMinimum as BoxMinimum,
    eliminated as eliminated,
    gauss_newton as gauss_newton,
    Iterate as Iterate,
    LeastSquaresOptions as LeastSquaresOptions,
    NormalEquations as NormalEquations,
    Solution as Solution,
    Stop as Stop,
)
from dano.solvers._trajectory import (
    TrajectoryConstraint as TrajectoryConstraint,
    TrajectoryOptions as TrajectoryOptions,
    TrajectoryProblem as TrajectoryProblem,
    TrajectoryProgress as TrajectoryProgress,
    TrajectorySolution as TrajectorySolution,
    TrajectoryStop as TrajectoryStop,
    Violation as Violation,
)
