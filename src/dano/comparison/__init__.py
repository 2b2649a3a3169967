"""Neural objects beside meshes of them, in our engine and in others."""

from dano.comparison._compare import (
    compare as compare,
    Comparison as Comparison,
    Row as Row,
    Scenery as Scenery,
    SHARES as SHARES,
    TIMESTEP as TIMESTEP,
)
