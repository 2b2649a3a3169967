"""What acts on joint coordinates in a step, how a step solves for what has kinks, and trees as tables."""

from dano.engine.joints._closure import Closure as Closure
from dano.engine.joints._forces import (
    JointForces as JointForces,
    Ramps as Ramps,
    Rough as Rough,
    STICKS as STICKS,
    STOPS as STOPS,
)
from dano.engine.joints._rows import (
    structure_of_trees as structure_of_trees,
    tree_lengths as tree_lengths,
    tree_rows as tree_rows,
)
from dano.engine.joints._structure import TreeStructure as TreeStructure
from dano.engine.joints._tables import (
    changing as changing,
    in_tables as in_tables,
    patch_rows as patch_rows,
    tree_tables as tree_tables,
    TreeTables as TreeTables,
)
