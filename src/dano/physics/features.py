"""What the kernels of a scene must know: code for anything else is left out when they are built.

These are the values of a build that knows everything. `dano.engine` builds kernels for a scene with those
that it needs (see `dano.native._instances`), which compiles and runs several times as fast.
"""

KINDS = frozenset(range(32))
"""Kinds of leaves of solids and of densities, see `leaves` and `shapes`; more than there are."""
DEGREES = frozenset({1, 2, 3})
"""Degrees of the splines of sampled distances and densities."""
UNIONS = True
"""Whether a solid has several leaves, or a density several parts."""
LAW = ""
"""A file whose functions stand in place of those of `point_law`; none if empty."""
PATCHES = True
"""Whether there are contacts with a patch law."""
TREES = True
"""Whether bodies hang on joints."""
LANES = 1
"""Lanes of a world: 1 on a CPU, 32 on a GPU."""
WIDE = True
"""Whether numbers have 64 bits."""
ADJOINTS = True
"""Whether adjoints of formulas are generated. Functions are marked for that when derivatives' modules run, so
these have functions of their own: what others compile would depend on which of them ran first."""
