"""Contact: what it sees of bodies, and the parameters of its laws (the laws themselves: `dano.physics`)."""

from dano.contact._centroid import CentroidLaw as CentroidLaw
from dano.contact._colliders import (
    Collider as Collider,
    Patch as Patch,
    SampleSet as SampleSet,
    Support as Support,
    SurfaceSet as SurfaceSet,
)
from dano.contact._distance import Distance as Distance, distance as distance
from dano.contact._distributed import (
    CHUNK as CHUNK,
    combined as combined,
    DistributedLaw as DistributedLaw,
    Materials as Materials,
    materials as materials,
)
from dano.contact._laws import (
    AbstractContactLaw as AbstractContactLaw,
    AbstractPatchLaw as AbstractPatchLaw,
    checked_parameter as checked_parameter,
    ContactParams as ContactParams,
    non_negative as non_negative,
    PARAMETER_RANGES as PARAMETER_RANGES,
    Setting as Setting,
    STANDARD_GRAVITY as STANDARD_GRAVITY,
)
