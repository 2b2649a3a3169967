"""Contact, in two halves that do not know each other: finding it, and turning it into force."""

from dano.contact._centroid import CentroidLaw as CentroidLaw
from dano.contact._colliders import (
    Collider as Collider,
    SampleSet as SampleSet,
    Support as Support,
    SurfaceSet as SurfaceSet,
)
from dano.contact._derivatives import (
    by_autodiff as by_autodiff,
    changes_of as changes_of,
    KEPT as KEPT,
    numbers_of as numbers_of,
)
from dano.contact._distributed import (
    combined as combined,
    DistributedLaw as DistributedLaw,
    materials as materials,
)
from dano.contact._finding import find as find, Impacts as Impacts, points_of as points_of
from dano.contact._geometry import (
    gather_geometry as gather_geometry,
    Geometry as Geometry,
    Links as Links,
    Part as Part,
)
from dano.contact._laws import (
    AbstractContactLaw as AbstractContactLaw,
    AbstractPatchLaw as AbstractPatchLaw,
    checked_parameter as checked_parameter,
    ContactParams as ContactParams,
    HARD as HARD,
    non_negative as non_negative,
    Setting as Setting,
    Softening as Softening,
    STANDARD_GRAVITY as STANDARD_GRAVITY,
)
from dano.contact._overlap import overlap as overlap, Patch as Patch
from dano.contact._points import (
    CHUNK as CHUNK,
    cross as cross,
    Found as Found,
    Motion as Motion,
    motion_at as motion_at,
    over_chunks as over_chunks,
    point_motion as point_motion,
    Points as Points,
)
from dano.contact._pressure import (
    Constants as Constants,
    constants as constants,
    Duals as Duals,
    first_duals as first_duals,
    Linear as Linear,
    linearized as linearized,
    Material as Material,
    Pressure as Pressure,
    traction as traction,
    updated as updated,
)
