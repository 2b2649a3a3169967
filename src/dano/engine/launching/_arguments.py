"""Parameters of kernels: structures of arrays that point to the memory that a launch is given."""

from collections.abc import Sequence

from dano.engine.launching._plans import OfWidth, Plan
from dano.native import Array, Layout, Parameters


def parameters_of(
    plan: Plan, layout: Layout, batched: Sequence[bool], n_worlds: int, *, wide: bool = True
) -> Parameters:
    """Parameters of a launch of a plan, whose arrays have shapes, but do not point to memory yet.

    Args:
        plan: The plan.
        layout: Of its kernel.
        batched: Whether each input differs between worlds.
        n_worlds: Number of worlds.
        wide: Whether numbers have 64 bits.
    """
    made, size = Parameters(layout), 8 if wide else 4
    for place, value in plan.numbers.items():
        made.put(place, (value.wide if wide else value.narrow) if isinstance(value, OfWidth) else value)
    differ = [*batched, *(True for _ in plan.outputs)]
    for (place, shape), differs in zip([*plan.inputs.items(), *plan.outputs.items()], differ, strict=True):
        row = shape.rows * shape.width * size if differs else 0
        made.point(place, (n_worlds, shape.rows), (row, shape.width * size))
    return made


def given_arrays(plan: Plan, parameters: Parameters) -> tuple[list[Array], list[tuple[Array, int]]]:
    """What a launch has to point to its memory, in the order of inputs and outputs.

    Returns:
        Arrays, and those whose derivatives are also to be found, with the number of the output that these
        are.
    """
    places = [*plan.inputs, *plan.outputs]
    arrays = [parameters.array(place) for place in places]
    gradients = [
        (arrays[places.index(place)], places.index(output))
        for place, output in plan.gradients.items()
        if output in places
    ]
    return arrays, gradients
