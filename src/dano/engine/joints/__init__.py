"""Kinematic trees as tables for kernels."""

from dano.engine.joints._rows import (
    structure_of_trees as structure_of_trees,
    tree_lengths as tree_lengths,
    tree_rows as tree_rows,
)
from dano.engine.joints._structure import tree_structure as tree_structure, TreeStructure as TreeStructure
