"""Launches but for their real numbers: which kernel, what it reads and writes, and where."""

import functools
import hashlib
import threading
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from dano.native import cpu_kernel, Features, instance, Kernel, kernel_in_lanes, Layout, layout_of


class Shape(NamedTuple):
    """Rows and numbers a row of an array of real numbers, without the axis of worlds."""

    rows: int
    width: int


class Build(NamedTuple):
    """What a kernel is built for."""

    lanes: int  # Lanes of a world
    wide: bool  # Whether numbers have 64 bits


class OfWidth(NamedTuple):
    """A number that depends on whether those inside a kernel have 64 bits or 32."""

    wide: float
    narrow: float


class OutputView(NamedTuple):
    """A part of the rows of an output as an array of its own."""

    output: str  # Place of the output, of rows of one number
    at: int  # Which number it begins with
    shape: Shape
    gradient: str = ""  # Place of an output with the derivatives by it, at the same numbers; empty for none


class WholeNumbers:
    """Whole numbers of a scene by place in a kernel's parameters, on the host.

    Attributes:
        arrays: The numbers, which nothing changes.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        """See the class."""
        self.arrays = arrays

    @functools.cached_property
    def digest(self) -> str:
        """A name of the numbers: those of many pairs would take long to compare in each call."""
        found = hashlib.sha256()
        for name, values in self.arrays.items():
            found.update(repr((name, values.shape, values.dtype.str)).encode())
            found.update(values.tobytes())
        return found.hexdigest()

    @functools.cached_property
    def n_pressing(self) -> int:
        """Pairs with samples that press."""
        return int((self.arrays["scene.pair_index"][:, 3] >= 0).sum())


@dataclass(eq=False)
class LaunchPlan:
    """A launch but for its real numbers."""

    module: str  # Module of `dano.engine.kernels` that has the kernel
    kernel: str  # Its name
    features: Features  # What it must know
    inputs: dict[str, Shape]  # Place of each input in the kernel's parameters, such as "scene.bodies"
    outputs: dict[str, Shape]  # The same of the outputs
    whole: WholeNumbers  # Whole numbers, the same for all worlds
    room: dict[str, int]  # Lengths of the arrays that a world of one lane works in, by place
    numbers: dict[str, Any]  # Other fields of the parameters, by place, some of them `OfWidth`
    views: dict[str, OutputView] = field(default_factory=dict)  # Arrays that are parts of outputs, by place
    _compiled: set[tuple[Build, str]] = field(default_factory=set, init=False)
    _layouts: dict[Build, Layout] = field(default_factory=dict, init=False)

    def named(self, *more: Any) -> str:
        """A name of launches for XLA, the same in each process, so that it finds what it compiled before.

        Args:
            *more: What else tells them from others.
        """
        told = [self.module, self.features.values, self.inputs, self.outputs, self.room, self.numbers]
        told += [self.views, *more]
        digest = hashlib.sha256(repr((told, self.whole.digest)).encode()).hexdigest()[:24]
        return f"dano_{self.kernel}_{digest}"

    @property
    def gradients(self) -> dict[str, str]:
        """Inputs to whose derivatives Warp itself adds, and the outputs that these are."""
        return {"scene.solids.coefficients": "room.bars.coefficients"} if self.adds else {}

    @property
    def views_of_room(self) -> dict[str, tuple[str, str]]:
        """Arrays that are others in the room, by place, and where there Warp adds derivatives by them."""
        return {place: (of, bars) for place, (of, bars) in _OF_ROOM.items() if {of, bars} <= self.room.keys()}

    @property
    def adds(self) -> bool:
        """Whether the kernel adds to its outputs, which have to be zero before."""
        return self.kernel == "pullback"

    def on_cpu(self) -> Kernel:
        """The kernel for one lane a world on this processor, which is compiled where nobody has."""
        return cpu_kernel(self.features, self.module, self.kernel)

    def in_lanes(self, build: Build) -> Any:
        """The kernel of Warp's for worlds of several lanes, not compiled."""
        return getattr(instance(self._in_lanes(build), self.module), self.kernel)

    def _in_lanes(self, build: Build) -> Features:
        return self.features.but(LANES=build.lanes, WIDE=build.wide)

    def layout(self, build: Build) -> Layout:
        """Where the kernel for several lanes reads its parameters."""
        if build not in self._layouts:
            self._layouts[build] = layout_of(self.in_lanes(build))
        return self._layouts[build]

    def compile(self, build: Build, device: str) -> None:
        """Compile the kernel for lanes of a device of Warp's, or load it: what goes wrong is said here."""
        key = build, device
        if key not in self._compiled:
            kernel_in_lanes(self._in_lanes(build), self.module, self.kernel, device)
            self._compiled.add(key)


_OF_ROOM = {
    "room.given.seen": ("room.bodies", "room.body_bars"),
    "room.given_trees.chains": ("room.trees.chains", "room.trees.chain_bars"),
    "room.given_patches.sums": ("room.patches.sums", "room.patches.sum_bars"),
}

_plans: dict[Any, LaunchPlan] = {}
_lock = threading.Lock()


def plan_of(new: LaunchPlan) -> LaunchPlan:
    """The first plan that is equal to a new one, so that compiled programs are found again."""
    tables = (new.inputs, new.outputs, new.room, new.numbers, new.views)
    key = (new.module, new.kernel, new.features, new.whole.digest, *(tuple(t.items()) for t in tables))
    with _lock:
        return _plans.setdefault(key, new)
