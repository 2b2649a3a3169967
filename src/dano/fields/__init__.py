"""Fields: what occupies space. Densities of any kind, shapes, grids, meshes, and readers for them."""

from dano.fields._bake import bake as bake, Baked as Baked, BakeError as BakeError
from dano.fields._base import (
    AbstractField as AbstractField,
    check_order as check_order,
    Jet as Jet,
    vmapped_jet as vmapped_jet,
)
from dano.fields._callable import CallableField as CallableField
from dano.fields._compose import (
    posed as posed,
    PosedField as PosedField,
    PosedShape as PosedShape,
    scaled as scaled,
    ScaledField as ScaledField,
    ScaledShape as ScaledShape,
    union as union,
    UnionField as UnionField,
    UnionShape as UnionShape,
)
from dano.fields._convex import (
    convex_hull as convex_hull,
    convex_pieces as convex_pieces,
    hull_field as hull_field,
    load_coacd as load_coacd,
)
from dano.fields._grid import degree_of as degree_of, DensityMoments as DensityMoments, GridField as GridField
from dano.fields._host import (
    density_at as density_at,
    distance_at as distance_at,
    jet_at as jet_at,
    normal_at as normal_at,
)
from dano.fields._parts import large_parts as large_parts, largest_part as largest_part
from dano.fields._primitives import (
    Box as Box,
    Capsule as Capsule,
    Cylinder as Cylinder,
    Ellipsoid as Ellipsoid,
    HalfSpace as HalfSpace,
    PRIMITIVES as PRIMITIVES,
    Sphere as Sphere,
)
from dano.fields._shapes import (
    AbstractPrimitive as AbstractPrimitive,
    AbstractShape as AbstractShape,
    occupancy as occupancy,
    SolidMoments as SolidMoments,
)
from dano.fields._signed_distance import (
    redistanced as redistanced,
    SignedDistanceGrid as SignedDistanceGrid,
    spread_distances as spread_distances,
)
from dano.fields.meshes import mesh_field as mesh_field, MESH_SUFFIXES as MESH_SUFFIXES, UNITS as UNITS
from dano.fields.readers import (
    companion_files as companion_files,
    FIELD_FORMATS as FIELD_FORMATS,
    FIELD_SUFFIXES as FIELD_SUFFIXES,
    is_splats as is_splats,
    load_field as load_field,
    offer_learned as offer_learned,
    read_splats as read_splats,
    save_field as save_field,
    Splats as Splats,
)
