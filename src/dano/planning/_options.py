"""How plans are searched for."""

from collections.abc import Sequence
from dataclasses import dataclass

from dano.checks import checked_count, checked_items, checked_kind
from dano.planning._problem import VIOLATION
from dano.planning._sampling import SamplingOptions
from dano.solvers import TrajectoryOptions

_ILQR = TrajectoryOptions(
    tolerance=1e-4, constraint_tolerance=VIOLATION, max_iterations=40, max_updates=20, penalty=10.0
)
"""Of plans through contact, whose last digits mean nothing."""


@dataclass(frozen=True)
class PlanOptions:
    """How a plan is searched for.

    Attributes:
        explore: Passes of CEM that improve the first guess of iLQR; 0 for none. None: where with the first
            guess no driven body touches one that misses its goal, paths that lead to contact are looked for,
            because derivatives do not lead there. The plan then says so (`Plan.explored`).
        softening: Factors < 1 of the contacts' stiffness to plan with first; each plan starts from the one
            before.
        ilqr: Of iLQR.
        sampling: Of CEM and MPPI.
        seed: Of the samples.
    """

    explore: int | None = None
    softening: Sequence[float] = ()
    ilqr: TrajectoryOptions = _ILQR
    sampling: SamplingOptions = SamplingOptions()
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all.

        Raises:
            ValueError: If one is out of range, or of another kind.
        """
        if self.explore is not None:
            checked_count("explore", self.explore, least=0)
        for factor in checked_items("softening", self.softening, float, int):
            if not 0 < factor < 1:
                raise ValueError(f"softening must hold factors between 0 and 1, got {factor}")
        checked_kind("ilqr", self.ilqr, TrajectoryOptions)
        checked_kind("sampling", self.sampling, SamplingOptions)
        checked_count("seed", self.seed, least=0)
