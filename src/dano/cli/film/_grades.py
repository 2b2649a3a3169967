"""What each stage says of itself in one number: whether to go on, and how far to believe the end."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from dano.cli.film._arguments import StageName
from dano.cli.film._place import Place, read_json
from dano.identification import load_motion
from dano.scene_file import load_run

Mark = Literal["good", "fair", "poor"]


class Grade(NamedTuple):
    """One number of a stage: the smaller, the better."""

    stage: StageName
    what: str
    value: float
    good: float  # Up to which it is what it usually is
    limit: float  # Above which the rest would be vain; infinite if nothing depends on it
    unit: str = "%"

    @property
    def mark(self) -> Mark:
        """In a word."""
        # A number that is not known is no good one.
        return "good" if self.value <= self.good else "fair" if self.value <= self.limit else "poor"

    @property
    def text(self) -> str:
        """The number, and what is usual."""
        usual = f"up to {self._shown(self.good)} {self.unit} is usual"
        return f"{self._shown(self.value)} {self.unit} ({self.mark}; {usual})"

    def _shown(self, value: float) -> str:
        return f"{100 * value:.3g}" if self.unit == "%" else f"{value:.3g}"


class FrictionVerdict(NamedTuple):
    """A friction with what it may be off by."""

    friction: float
    stated: float | None  # Standard error of the fit
    error: float | None  # The same with what poses and object may be off by

    @staticmethod
    def of(
        friction: float, stated: float | None, misfit: float, unexplained: float, share: float
    ) -> "FrictionVerdict":
        """The error of a fit, widened.

        Poses that the simulation misses by more standard deviations than they may be off say that object,
        camera or law is wrong, in a way that more frames do not mend: the error grows by that factor. An
        object that is too large by a share makes ways too long by it; so does what silhouettes leave open.

        Args:
            friction: Found.
            stated: Its standard error by the fit; None: unknown.
            misfit: Root mean square by which the simulation misses the poses [standard deviations].
            unexplained: Share of the silhouettes that the object does not explain.
            share: Standard deviation of the object's size, by training.
        """
        if stated is None:
            return FrictionVerdict(friction, None, None)
        of_object = friction * float(np.hypot(share, max(unexplained - _USUAL, 0.0)))
        return FrictionVerdict(friction, stated, float(np.hypot(stated * max(1.0, misfit), of_object)))


_USUAL = 0.03
"""Share of the silhouettes that no learned object explains: blurred edges, highlights."""


DECIDING = "object", "motion", "friction"
"""Stages whose numbers decide whether to believe a friction."""


def grade_of(place: Place, stage: str) -> Grade:
    """The number of a stage that has been made."""
    return _GRADES[stage](place)


def grades_of(place: Place, stages: Sequence[str]) -> list[Grade]:
    """Those of some stages that have been made."""
    return [grade_of(place, stage) for stage in stages]


def _check(place: Place) -> Grade:
    walk = read_json(place.folder / "check.json")["walk"]
    missing = 1 - walk["marked"] / max(walk["looked_at"], 1)
    return Grade("check", "photographs without the marker", missing, 0.5, 0.9)


def _cameras(place: Place) -> Grade:
    found = read_json(place.folder / "cameras.json")
    error = found.get("reprojection_error")
    value = float("nan") if error is None else float(error)
    return Grade("cameras", "distance of points from where cameras see them", value, 1.2, 4.0, "px")


def _masks(place: Place) -> Grade:
    found = read_json(place.folder / "fit.json")["residual"]
    return Grade("masks", "silhouettes that no solid explains", float(found), 0.04, 0.12)


def _object(place: Place) -> Grade:
    return Grade("object", "pictures that the object does not explain", unexplained(place), 0.04, 0.1)


def unexplained(place: Place) -> float:
    """Share of the silhouettes that the learned object does not explain."""
    return float(read_json(place.folder / "object.json")["unexplained"])


def _motion(place: Place) -> Grade:
    quality = read_json(place.folder / "motion.json")["quality"]
    return Grade("motion", "silhouettes in the film beside the object's", 1 - float(quality), 0.05, 0.2)


def _friction(place: Place) -> Grade:
    misfit = float(read_json(place.folder / "friction.json")["errors"]["rms"])
    return Grade("friction", "by how much the simulation misses the poses", misfit, 1.5, 4.0, "σ")


def _scene(place: Place) -> Grade:
    """How much longer or shorter the simulated way is than the filmed one."""
    moved = load_run(place.folder / "run.npz").trajectory.states.position
    motion = load_motion(place.folder / "slide.npz")
    seen = motion.position[np.isfinite(motion.position[:, 0, 0]), 0]
    filmed = float(np.linalg.norm(seen[-1] - seen[0]))
    simulated = float(np.linalg.norm(np.asarray(moved[-1, 0] - moved[0, 0])))
    value = abs(simulated / max(filmed, 1e-9) - 1)
    return Grade("scene", "simulated way beside the filmed one", value, 0.05, float("inf"))


_GRADES: Mapping[str, Callable[[Place], Grade]] = {
    "check": _check,
    "cameras": _cameras,
    "masks": _masks,
    "object": _object,
    "motion": _motion,
    "friction": _friction,
    "scene": _scene,
}


def verdict_of(place: Place) -> FrictionVerdict:
    """The friction with its widened error."""
    found = read_json(place.folder / "friction.json")
    (friction,), (stated,) = found["values"].values(), found["standard_errors"].values()
    alike = load_motion(place.folder / "slide.npz").alike
    share = 0.0 if alike is None else float(alike[2])
    return FrictionVerdict.of(friction, stated, float(found["errors"]["rms"]), unexplained(place), share)


def write_verdict(path: Path, place: Place, grades: list[Grade], verdict: FrictionVerdict) -> None:
    """The last page: the friction, the number of each stage, and where to look."""
    from dano.report import write_grades

    rows = [[grade.stage, grade.what, grade.text] for grade in grades]
    wide = "unknown" if verdict.error is None else f"{verdict.error:.2g}"
    told = f"Friction {verdict.friction:.4g} ± {wide}"
    if verdict.stated is not None:
        told += f" (the fit alone says ± {verdict.stated:.2g})"
    write_grades(path, place.body, told, rows, [g.stage for g in grades if g.mark == "poor"])
