"""Shapes from triangle meshes: files of many kinds, how they are repaired, and distances on a grid."""

from dano.fields.meshes._field import mesh_field as mesh_field, mesh_moments as mesh_moments
from dano.fields.meshes._reading import (
    checked_units as checked_units,
    MESH_SUFFIXES as MESH_SUFFIXES,
    UNITS as UNITS,
)
