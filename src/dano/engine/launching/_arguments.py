"""Parameters of kernels: structures of arrays that point to the memory that a launch is given."""

from collections.abc import Sequence
from typing import NamedTuple

from dano.engine.launching._plans import LaunchPlan, OfWidth
from dano.native import Array, Layout, Parameters


def parameters_of(
    plan: LaunchPlan, layout: Layout, batched: Sequence[bool], n_worlds: int, *, wide: bool = True
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
    for place, view in plan.views.items():
        row = plan.outputs[view.output].rows * size
        made.point(place, (n_worlds, view.shape.rows), (row, view.shape.width * size))
    return made


class Pointed(NamedTuple):
    """An array that points into an input or an output."""

    array: Array
    number: int  # Of the input or output, counted through
    at: int  # How far into it [bytes]
    is_gradient: bool  # Whether it is where Warp adds derivatives by the array

    def point(self, pointers: Sequence[int]) -> None:
        """Point it to its memory, from the addresses of inputs and outputs."""
        address = pointers[self.number] + self.at
        if self.is_gradient:
            self.array.grad = address
        else:
            self.array.data = address


def given_arrays(plan: LaunchPlan, parameters: Parameters, *, wide: bool = True) -> list[Pointed]:
    """What a launch has to point to its memory.

    Args:
        plan: The plan.
        parameters: Of the launch.
        wide: Whether numbers have 64 bits.
    """
    places = [*plan.inputs, *plan.outputs]
    found = [Pointed(parameters.array(place), k, 0, False) for k, place in enumerate(places)]
    for place, output in plan.gradients.items():
        if output in places and place in places:
            found.append(Pointed(parameters.array(place), places.index(output), 0, True))
    for place, view in plan.views.items():
        array, at = parameters.array(place), view.at * (8 if wide else 4)
        found.append(Pointed(array, places.index(view.output), at, False))
        if view.gradient:
            found.append(Pointed(array, places.index(view.gradient), at, True))
    return found
