"""Doubts about masks: parts of the object that were taken for background.

A mask by a threshold leaves out what is as dark as a dark background, and one that was made on a table what
looks like that. A bite out of few masks is a hole in the hull of all silhouettes. Nothing in one photograph
tells such a bite from a gap through which the background is seen. But if the silhouettes fit a hull better
that more of them may miss, then bites are likely: they are left open, and what the other photographs show
decides.
"""

import numpy as np

from dano.vision.capture import Capture, hull_distance, left_out, NodeGrid, silhouette, spare_of, View
from dano.vision.training._survey import silhouette_residual, Survey, survey

_CONSISTENT = 0.015
"""Residual of silhouettes that are not doubted."""

_LOST = 0.04, 0.08
"""Shares of the views that may miss a point of the object, tried one after the other."""

_LOOKS = 40
"""Views at most that a hull is compared with."""


def with_doubts(capture: Capture, found: Survey) -> tuple[Capture, Survey]:
    """The capture with its doubts about masks, and the survey without what they had cut off the hull.

    Masks from an alpha channel are taken as stated. At least one photograph may be wrong about a point.

    Args:
        capture: Photographs with masks.
        found: What `survey` says about it; its residual stays that of the masks as they are.
    """
    train = capture.split("train")
    if found.residual < _CONSISTENT or all(_is_stated(view) for view in train):
        return capture, found
    hulls, residuals = [found.hull], [silhouette_residual(train, found.box, found.hull, _LOOKS)]
    for lost in _LOST:
        hulls.append(hull_distance(train, found.box, lost, spare=spare_of(len(train), lost)))
        residuals.append(silhouette_residual(train, found.box, hulls[-1], _LOOKS))
        if residuals[-1] >= min(residuals[:-1]):
            break
    best = int(np.argmin(residuals))
    if best == 0:
        return capture, found
    views = [_doubted(view, found.box, hulls[best]) for view in capture.views]
    doubted = Capture(views, capture.source)
    shares = [
        float(view.doubt.sum() / view.mask.sum())
        for view in views
        if view.doubt is not None and view.mask is not None
    ]
    if not shares:
        return capture, found
    again = survey(doubted, max(found.box.shape))
    told = (
        f"{len(shares)} of {len(views)} masks leave out up to {100 * max(shares):.0f} % of what most others"
        " show, as masks by a threshold do with shadows: what is there is left to the photographs"
    )
    return doubted, again._replace(residual=found.residual, warnings=(*found.warnings, told))


def _is_stated(view: View) -> bool:
    """Whether its mask is an alpha channel."""
    return view.cut_out and view.background is None


def _doubted(view: View, box: NodeGrid, hull: np.ndarray) -> View:
    """A view whose mask is doubted where it leaves out more than a rim of a hull's silhouette."""
    if view.mask is None or _is_stated(view):
        return view
    missing = left_out(view.mask, silhouette(view.camera, box, hull))
    if not missing.any():
        return view
    return view.replaced(doubt=missing if view.doubt is None else np.maximum(view.doubt, missing))
