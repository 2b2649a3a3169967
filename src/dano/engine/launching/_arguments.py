"""Parameters of kernels: structures of arrays that point to the memory that a launch is given."""

from collections.abc import Sequence
from typing import Any

from dano.engine.launching._plans import Build, OfWidth, Plan


class Arguments:
    """Parameters of a kernel.

    Attributes:
        places: Places of what a launch reads and writes, in its order.
    """

    def __init__(self, plan: Plan, build: Build, device: str):
        """Without any arrays.

        Args:
            plan: The plan.
            build: What the kernel is built for.
            device: Name in Warp of where it runs.
        """
        self._plan, self._build, self._device = plan, build, device
        self._kernel = plan.kernel_of(build)
        self._given = {argument.label: argument.type() for argument in self._kernel.adj.args}
        self.places = [*plan.inputs, *plan.outputs]
        for place, value in plan.numbers.items():
            if isinstance(value, OfWidth):
                value = value.wide if build.wide else value.narrow
            self.put(place, value)

    def _found(self, place: str) -> tuple[Any, str, Any]:
        """What has a place such as "scene.solids.leaves", the field's name, and what an array there holds."""
        first, *path, field = place.split(".")
        owner = self._given[first]
        for name in path:
            owner = getattr(owner, name)
        return owner, field, getattr(owner._cls.vars[field].type, "dtype", None)

    def item(self, place: str) -> int:
        """Bytes of an item of the array at a place."""
        import warp as wp

        return wp.types.type_size_in_bytes(self._found(place)[2])

    def put(self, place: str, value: Any) -> None:
        """Set a number."""
        owner, field, _ = self._found(place)
        setattr(owner, field, value)

    def point(self, place: str, shape: tuple[int, ...], strides: tuple[int, ...], pointer: int = 0) -> None:
        """Have an array at a place, with strides in bytes, and at an address, which a launch may change."""
        import warp as wp

        owner, field, dtype = self._found(place)
        array: Any = wp.array(
            ptr=pointer, dtype=dtype, shape=shape, strides=strides, device=self._device, copy=False
        )
        setattr(owner, field, array)

    def point_all(self, batched: Sequence[bool], n_worlds: int) -> None:
        """Have arrays for what a launch reads and writes; inputs that are `batched` differ between worlds."""
        plan, size = self._plan, 8 if self._build.wide else 4
        differ = [*batched, *(True for _ in plan.outputs)]
        for place, differs in zip(self.places, differ, strict=True):
            shape = plan.inputs[place] if place in plan.inputs else plan.outputs[place]
            row = shape.rows * shape.width * size if differs else 0
            self.point(place, (n_worlds, shape.rows), (row, shape.width * size))

    def recorded(self, first: int, count: int) -> Any:
        """The launch of some worlds, which reads these parameters."""
        import warp as wp

        self.put("launch.first_world", first)
        return wp.launch(
            self._kernel,
            (count, self._build.lanes),
            list(self._given.values()),
            device=self._device,
            block_dim=self._build.lanes,
            record_cmd=True,
        )

    def descriptor(self, place: str) -> Any:
        """Where the recorded launch reads the address of an array, and of its derivatives."""
        owner, field, _ = self._found(place)
        return getattr(owner.__ctype__(), field)

    def pointers(self) -> tuple[list[Any], list[tuple[Any, int]]]:
        """What a launch has to point to its memory, in the order of `places`.

        Returns:
            Descriptors of arrays, and those whose derivatives are also to be found, with the number of the
            output that these are.
        """
        arrays = [self.descriptor(place) for place in self.places]
        gradients = [
            (arrays[self.places.index(place)], self.places.index(output))
            for place, output in self._plan.gradients.items()
            if output in self.places
        ]
        return arrays, gradients
