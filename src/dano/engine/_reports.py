"""When a step's solve stops, and what it says of itself."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class SolverOptions(NamedTuple):
    """When a step's Newton solve stops: see `VariationalEngine`."""

    tolerance: float | None = None
    max_iterations: int = 500


class Report(NamedTuple):
    """What the solver says of a step: see `Trajectory`; and whether its list of points was too short."""

    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    overflow: Bool[Array, ""] | None = None
