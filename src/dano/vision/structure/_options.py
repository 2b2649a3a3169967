"""What is asked of structure from motion: every choice, with its default."""

import dataclasses

import numpy as np

from dano.checks import checked_choice, checked_count, checked_kind, checked_number
from dano.maths import checked_array, checked_numbers

FEATURES_ON = ("auto", "everything", "object", "surroundings")
UPS = ("auto", "marker", "plane", "cameras", "none")
LENSES = ("radial", "pinhole", "full")
MARKERS = (
    *("DICT_APRILTAG_36h11", "DICT_APRILTAG_36h10", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5"),
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL",
)

FEWEST = 5
"""Pictures below which a model is not worth having: poses of three fit almost anything."""


@dataclasses.dataclass(frozen=True)
class KnownLength:
    """A distance that was measured, and where its two ends are in some pictures.

    Attributes:
        length: The distance [m].
        ends: By picture's name: x, y of the one end and x, y of the other [pixels of the upright picture].
            Two pictures at least.
        pixel_error: How exact these coordinates are, as a standard deviation [pixels].
    """

    length: float
    ends: dict[str, tuple[float, float, float, float]]
    pixel_error: float = 1.0

    def __post_init__(self) -> None:
        """Check it.

        Raises:
            ValueError: If the length is not positive, or fewer than two pictures show its ends.
        """
        checked_number("length", self.length, above=0)
        checked_kind("ends", self.ends, dict)
        for name, places in self.ends.items():
            checked_array(f"ends in {name!r}", places, (4,))
        if len(self.ends) < 2:
            raise ValueError(f"ends must be given in two pictures at least, got {sorted(self.ends)}")
        checked_number("pixel_error", self.pixel_error, above=0)


@dataclasses.dataclass(frozen=True)
class PoseOptions:
    """How to find cameras.

    Attributes:
        focal: Known focal length, or two, across and down [pixels of the upright picture], kept as they are;
            None: estimated.
        centre: Known principal point [pixels]; None: the middle of the picture.
        distortion: Known k₁, k₂, p₁, p₂ of OpenCV's model; only with `focal`.
        lens: What is estimated: "radial" (focal length and k₁), "pinhole" (focal length), "full" (two focal
            lengths, k₁, k₂, p₁, p₂).
        features_on: Where points are looked for, if there are masks. "object" for turntables, "surroundings"
            for walks around an object, "everything"; "auto": the object if what is around it is plain or
            stands still in the pictures, the surroundings otherwise.
        features: Most points of a picture.
        marker_size: Side of the black square of printed markers [m]; None: there are none.
        marker_family: Dictionary of OpenCV, by default AprilTag 36h11.
        known_length: A measured distance; None: there is none.
        up: What shows where up is: "marker" (lies flat), "plane" (most of the surroundings), "cameras" (were
            held level), "none"; "auto": the first of them that can be had.
        frames: Most frames of a video, or of several together.
        since: Take frames of a video from this time on [s]; None: from its beginning.
        until: Take frames up to this time [s]; None: to its end.
        model: Which model to keep if the pictures fall into several, from 1, the largest.
        seed: Of everything random.
    """

    focal: int | float | tuple[float, float] | None = None
    centre: tuple[float, float] | None = None
    distortion: tuple[float, float, float, float] | None = None
    lens: str = "radial"
    features_on: str = "auto"
    features: int = 3000
    marker_size: float | None = None
    marker_family: str = "DICT_APRILTAG_36h11"
    known_length: KnownLength | None = None
    up: str = "auto"
    frames: int = 80
    since: int | float | None = None
    until: int | float | None = None
    model: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all choices.

        Raises:
            ValueError: If one is out of range.
        """
        for name, values in (
            ("lens", LENSES),
            ("features_on", FEATURES_ON),
            ("up", UPS),
            ("marker_family", MARKERS),
        ):
            checked_choice(name, getattr(self, name), list(values))
        if self.focal is not None:
            lengths = checked_numbers("focal", self.focal)
            if lengths.shape not in ((), (2,)) or not np.all(np.isfinite(lengths) & (lengths > 0)):
                raise ValueError(
                    f"focal must be one number or two, finite and > 0 [pixels], got {self.focal}"
                )
        if self.marker_size is not None:
            checked_number("marker_size", self.marker_size, above=0)
        for name in ("centre", "distortion"):
            if getattr(self, name) is not None and self.focal is None:
                raise ValueError(f"{name} needs focal: only a lens that is known as a whole is kept as it is")
        checked_count("features", self.features, least=100, most=20000)
        checked_count("frames", self.frames, least=FEWEST, most=2000)
        if self.up == "marker" and self.marker_size is None:
            raise ValueError("up='marker' needs marker_size, the side of the printed square [m]")
        checked_count("model", self.model)
        checked_count("seed", self.seed, least=0)

    @property
    def focals(self) -> tuple[float, float] | None:
        """The known focal lengths across and down [pixels]; None if they are estimated."""
        if self.focal is None:
            return None
        return self.focal if isinstance(self.focal, tuple) else (float(self.focal), float(self.focal))
