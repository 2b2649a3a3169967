"""Contact: overlap of density fields and the laws that turn it into force."""

from dano.contact._colliders import Collider as Collider, SampleSet as SampleSet, Support as Support
from dano.contact._laws import (
    AbstractContactLaw as AbstractContactLaw,
    CentroidLaw as CentroidLaw,
    ContactParams as ContactParams,
    non_negative as non_negative,
)
from dano.contact._overlap import overlap as overlap, Patch as Patch
