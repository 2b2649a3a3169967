"""Kinds of leaves of solids and densities, by number; a field's `kind` is the name in lower case."""

HALF_SPACE, SPHERE, BOX, CAPSULE, CYLINDER, ELLIPSOID, GRID, DENSITY = range(8)
"""Planes, shapes, grids of distances, grids of densities; the next kind would be 8."""
CELL = 4
"""Cells of a grid along an axis that have one lower bound."""
