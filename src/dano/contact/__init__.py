"""Contact: overlap of density fields, pressure on surfaces, and the laws that turn them into force."""

from dano.contact._centroid import CentroidLaw as CentroidLaw
from dano.contact._colliders import (
    Collider as Collider,
    SampleSet as SampleSet,
    Support as Support,
    SurfaceSet as SurfaceSet,
)
from dano.contact._distributed import DistributedLaw as DistributedLaw, SurfacePatch as SurfacePatch
from dano.contact._laws import (
    AbstractContactLaw as AbstractContactLaw,
    checked_parameter as checked_parameter,
    ContactParams as ContactParams,
    non_negative as non_negative,
    Setting as Setting,
    Softening as Softening,
)
from dano.contact._overlap import overlap as overlap, Patch as Patch
