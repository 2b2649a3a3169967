"""How to train: every number that may be chosen."""

import dataclasses

from dano.checks import checked_count, checked_number
from dano.maths import checked_array


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """How to train.

    Attributes:
        resolution: Nodes along the longest side of the finest grid of distances.
        iterations: Steps in all; a third of them on a grid of two thirds the resolution.
        batch: Rays per step.
        features: Numbers that say what a place looks like.
        rate_distance: Learning rate of the distances, in cells per step.
        rate_features: Learning rate of the features; None for 0.01 where the light of photographs is known,
            and 0.1 where it is not and features alone say which places are bright.
        rate_network: Learning rate of the network.
        mask_weight: Weight of the mask's error.
        eikonal_weight: Weight of (|∇d| − 1)².
        smoothness_weight: Weight of (h ∇²d)².
        cavities: Whether to look for cavities of the visual hull first (see `find_cavities`).
        cameras: Whether to correct poses and lenses by up to a few pixels.
        blur: Distance over which the surface is soft, in pixels, at the start and from 70 % of the steps on.
        check_every: Steps between evaluations on held-out views, which decide when to stop.
        seconds: Stop after this time [s]; None for no limit.
        seed: Of everything random.
    """

    resolution: int = 96
    iterations: int = 800
    batch: int = 4096
    features: int = 8
    rate_distance: float = 0.15
    rate_features: float | None = None
    rate_network: float = 0.003
    mask_weight: float = 0.5
    eikonal_weight: float = 0.003
    smoothness_weight: float = 0.001
    cavities: bool = True
    cameras: bool = False
    blur: tuple[float, float] = (0.5, 0.15)
    check_every: int = 200
    seconds: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all numbers.

        Raises:
            ValueError: If one is out of range.
        """
        ranges = {
            "resolution": (16, 384),
            "iterations": (1, 10**6),
            "batch": (16, 2**20),
            "features": (1, 64),
            "check_every": (1, 10**6),
        }
        for name, (low, high) in ranges.items():
            checked_count(name, getattr(self, name), least=low, most=high)
        rates = {"rate_distance": self.rate_distance, "rate_network": self.rate_network}
        if self.rate_features is not None:
            rates["rate_features"] = self.rate_features
        for name, rate in rates.items():
            checked_number(name, rate, above=0)
        for name in ("mask_weight", "eikonal_weight", "smoothness_weight"):
            checked_number(name, getattr(self, name), least=0)
        checked_array("blur", self.blur, (2,), above=0)
        if self.seconds is not None:
            checked_number("seconds", self.seconds, above=0)
        checked_count("seed", self.seed, least=0)

    def rate_of_features(self, *, lit: bool) -> float:
        """`rate_features`, or the rate for photographs whose light is known (`lit`) or not."""
        return self.rate_features or (0.01 if lit else 0.1)
