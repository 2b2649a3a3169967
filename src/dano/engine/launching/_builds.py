"""Which kernels are compiled: few builds that serve all scenes."""

import functools

from dano.native import Features, kind_number, shape_kinds

_FORWARD = ("rollout", "touch", "listing")
_DERIVATIVES = ("derivatives.pullback", "derivatives.pushforward")


@functools.cache
def builds() -> tuple[Features, ...]:
    """Builds of kernels that serve all scenes, from the smallest on.

    Each takes minutes to compile, so they are few: what is left out of one has to make it much smaller or
    faster. A plane knows no shapes; shapes know no splines; bodies that move freely no trees.
    """
    plane, grid, density = map(kind_number, ("half_space", "grid", "density"))
    shapes = shape_kinds()
    everything = frozenset({*shapes, grid, density})
    sets = (
        # kinds of leaves, contacts with a patch law, bodies on joints
        (frozenset({plane}), False, False),
        (frozenset({plane}), True, False),
        (shapes, False, False),
        (everything, False, False),
        (everything, True, False),
        (shapes, False, True),
        (everything, False, True),
        (everything, True, True),
    )
    return tuple(
        Features(
            ADJOINTS=False,
            LAW="",
            KINDS=kinds,
            DEGREES=frozenset({1, 2, 3}) if grid in kinds else frozenset(),
            UNIONS=len(kinds) > 1,
            PATCHES=patches,
            TREES=trees,
        )
        for kinds, patches, trees in sets
    )


def build_for(kinds: set[int], *, law: str, unions: bool, patches: bool, trees: bool) -> Features:
    """The smallest build that knows what a scene needs.

    Args:
        kinds: Of leaves.
        law: File of functions of its point contacts, empty for the usual ones.
        unions: Whether a solid or a density has several leaves.
        patches: Whether there are contacts with a patch law.
        trees: Whether bodies hang on joints.
    """
    needed = {"UNIONS": unions, "PATCHES": patches, "TREES": trees}
    for each in builds():
        values = dict(each.values)
        if kinds <= values["KINDS"] and all(values[name] >= need for name, need in needed.items()):
            return each.but(LAW=law)
    raise AssertionError(f"no build knows {kinds}, {needed}")


def kernel_builds() -> list[tuple[Features, str]]:
    """Features and modules of all kernels that scenes without a law of their own ask for."""
    forward = [(each, name) for each in builds() for name in _FORWARD]
    derivatives = [(each.but(ADJOINTS=True), name) for each in builds() for name in _DERIVATIVES]
    return [(each, f"dano.engine.kernels.{name}") for each, name in (*forward, *derivatives)]
