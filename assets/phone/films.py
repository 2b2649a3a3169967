"""The phone films: what moves where, in which light, and how it is filmed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from solids import block_mesh, Mesh, mug_mesh, soap_mesh

from phone.camera import Exposure
from phone.motion import Motion, Simulated, Slide

MESHES: dict[str, Callable[[], Mesh]] = {"block": block_mesh, "mug": mug_mesh, "soap": soap_mesh}
mesh_of = cache(lambda name: MESHES[name]())


@dataclass(frozen=True)
class Film:
    """What is filmed, and how.

    Attributes:
        object: Name of the object.
        friction: Of the table.
        motion: Makes the motion.
        frames: Number of frames.
        rate: Frames/s.
        light: "sun" or "lamps".
        exposure: Shutter and readout.
        crf: Quality of H.264.
        noise: Relative to a usual phone.
        off: Factor by which the exposure is wrong at first.
        sharpened: By the camera, share of unsharp masking.
        papers: Sheets of newspaper.
        patches: Coloured patches on the table.
        passes: From when to when a hand passes [s].
        eye: Where the camera is [m].
        target: What it looks at [m].
        seed: Of the table and the noise.
    """

    object: str
    friction: float
    motion: Callable[["Film"], Motion]
    frames: int
    rate: int
    light: str
    exposure: Exposure
    crf: int
    noise: float = 1.0
    off: float = 1.25
    sharpened: float = 0.3
    papers: int = 2
    patches: int = 10
    passes: tuple[float, float] | None = None
    eye: tuple[float, float, float] = (0.10, -0.46, 0.36)
    target: tuple[float, float, float] = (0.0, 0.02, 0.0)
    seed: int = 1


def slide(
    end: tuple[float, float, float], distance: float, heading: float, turn: float
) -> Callable[[Film], Motion]:
    """A slide with the film's friction; see `Slide`."""
    return lambda film: Slide(film.friction, end, distance, heading, turn)


def simulated(kind: str, start: tuple[float, ...], velocity: tuple[float, ...]) -> Callable[[Film], Motion]:
    """What MuJoCo makes of a start, with the film's object and friction; see `Simulated`."""
    return lambda film: Simulated(mesh_of(film.object), film.friction, start, velocity, kind)


FILMS = {
    "soap_desk": Film(
        "soap",
        0.22,
        slide((0.10, 0.05, 0.0151), 0.27, 0.35, 0.5),
        frames=28,
        rate=30,
        light="sun",
        exposure=Exposure(1 / 120, 0.012),
        crf=21,
    ),
    "block_plain": Film(
        "block",
        0.30,
        slide((0.11, 0.03, 0.0201), 0.22, 0.25, -0.7),
        frames=26,
        rate=30,
        light="sun",
        exposure=Exposure(1 / 250, 0.008),
        crf=21,
        off=1.1,
        papers=0,
        patches=0,
        seed=2,
    ),
    "block_paper": Film(
        "block",
        0.25,
        slide((0.12, 0.06, 0.0201), 0.30, 0.30, 0.9),
        frames=28,
        rate=30,
        light="lamps",
        exposure=Exposure(1 / 120, 0.018),
        crf=29,
        noise=1.4,
        off=1.4,
        patches=22,
        seed=3,
    ),
    "block_throw": Film(
        "block",
        0.35,
        simulated("throw", (-0.36, -0.06, 0.09, 0.9, 0.3, 0.2, 0.3), (0.95, 0.20, 0.75, 5, 9, 4)),
        frames=54,
        rate=60,
        light="sun",
        exposure=Exposure(1 / 160, 0.012),
        crf=29,
        patches=14,
        seed=4,
    ),
    "mug_spin": Film(
        "mug",
        0.22,
        simulated("spin", (-0.15, -0.01, 0.0001, 0.35, 0, 0, 1), (0.85, 0.17, 0, 0, 0, 6)),
        frames=48,
        rate=60,
        light="sun",
        exposure=Exposure(1 / 200, 0.010),
        crf=21,
        passes=(0.16, 0.64),
        target=(0.0, 0.02, 0.03),
        seed=5,
    ),
    "held_block_slide": Film(
        "block",
        0.30,
        slide((0.06, 0.04, 0.0201), 0.42, 0.2, 2.2),
        frames=46,
        rate=60,
        light="sun",
        exposure=Exposure(1 / 160, 0.012),
        crf=21,
        patches=18,
        seed=6,
    ),
    "held_mug_slide": Film(
        "mug",
        0.26,
        slide((0.12, 0.05, 0.0), 0.28, 0.3, 2.6),
        frames=30,
        rate=30,
        light="lamps",
        exposure=Exposure(1 / 120, 0.018),
        crf=29,
        noise=1.4,
        passes=(0.12, 0.60),
        target=(0.0, 0.02, 0.03),
        seed=7,
    ),
    "held_soap_spin": Film(
        "soap",
        0.20,
        simulated("spin", (-0.17, 0.0, 0.0151, 1, 0, 0, 0.2), (0.95, 0.18, 0, 0, 0, -9)),
        frames=30,
        rate=30,
        light="lamps",
        exposure=Exposure(1 / 120, 0.015),
        crf=29,
        patches=16,
        passes=(0.32, 0.80),
        seed=8,
    ),
    "held_soap_throw": Film(
        "soap",
        0.30,
        simulated("throw", (-0.37, -0.02, 0.10, 0.8, -0.3, 0.4, 0.1), (1.0, 0.10, 0.70, -4, 8, 6)),
        frames=54,
        rate=60,
        light="lamps",
        exposure=Exposure(1 / 160, 0.012),
        crf=21,
        seed=9,
    ),
}
