"""How a film is tracked."""

from dataclasses import dataclass

from dano.checks import checked_choice, checked_count, checked_number

MASK_SOURCES = ("auto", "given", "static", "plain", "object")
LOSSES = ("photometric", "silhouette", "paper")


@dataclass(frozen=True)
class TrackOptions:
    """How a film is tracked.

    Attributes:
        masks: Where masks come from. "given": files, or alpha. "static": what differs from the place without
            the object, which a picture shows (`background` of `track`) or the median of all frames. "plain":
            what differs from a background of one colour. "object": what looks like the object near where it
            is expected, and unlike what is around it; begins as "static". "auto": given ones, else "plain"
            if the frames' border is of one colour, else "object".
        loss: What is minimised. "photometric": silhouettes and colours, robustly. "silhouette": no colours.
            "paper": ‖T(p) − M‖² + ‖B(T(p)) − B(M)‖² of Le Cleac'h et al., T the rendered opacity, M the mask,
            B a blur.
        views: Directions from which the start looks at the object.
        turns: Turns about the line of sight that the start tries for each of them.
        candidates: Best of these that the start refines.
        rays: Pixels of a frame that the finest refinement takes.
        lost: Overlap of mask and silhouette, as intersection over union, below which the object is lost.
        search_every: After how many frames a lost object is looked for again in all orientations.
        shutter: How long a frame is exposed [s], by which what moves is blurred; 0 takes it to be sharp. The
            time of a frame is the middle of its exposure.
        readout: How much later the last row of a frame is exposed than the first (rolling shutter) [s]; the
            time of a frame is that of its middle row.
        table: Height z of a level table [m, W] under the object. It lies and slides there on one of the faces
            of its hull, and its shadow says where the sun is; None: no table is known, and colours say where
            the sun is, less well.
        seed: Of all random numbers.
    """

    masks: str = "auto"
    loss: str = "photometric"
    views: int = 96
    turns: int = 24
    candidates: int = 8
    rays: int = 2048
    lost: float = 0.75
    search_every: int = 3
    shutter: float = 0.0
    readout: float = 0.0
    table: float | None = None
    seed: int = 0

    def __post_init__(self):
        checked_choice("masks", self.masks, MASK_SOURCES)
        checked_choice("loss", self.loss, LOSSES)
        least = {"views": 12, "turns": 4, "candidates": 1, "rays": 256, "search_every": 1}
        for name, low in least.items():
            checked_count(name, getattr(self, name), least=low)
        for name in ("shutter", "readout"):
            if not 0 <= checked_number(name, getattr(self, name)) < 1:
                raise ValueError(f"{name} must be ≥ 0 and < 1 s, got {getattr(self, name)}")
        if self.table is not None:
            checked_number("table", self.table)
        if not 0 < self.lost < 1:
            raise ValueError(f"lost must lie between 0 and 1, got {self.lost}")
