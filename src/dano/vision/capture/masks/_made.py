"""Masks for photographs that have none: from a plain background, a table, or by a segmentation network."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dano.extras import NETWORKS
from dano.fields import largest_part
from dano.vision.capture._capture import Capture, View
from dano.vision.capture._hull import hull_distance, object_box, silhouettes, spare_of
from dano.vision.capture._node_grid import NodeGrid
from dano.vision.capture._ray_set import rays_of
from dano.vision.capture._shown import silhouette
from dano.vision.capture.masks._decided import left_out
from dano.vision.capture.masks._standing import standing_masks

_BORDER = 0.03
"""Share of the image on each side that is taken for background."""

_PLAIN = 0.06
"""Most that the middle 80 % of a plain background may deviate from its median, in sRGB."""

_CLEARLY_OBJECT = 0.12
"""Deviation from the background, in sRGB, that always counts as object."""

_BAY = 0.08
"""Half the width of bays in a mask that may be shadows, as a share of the root of its area."""

_DOUBTED, _USUAL = 0.1, 0.01
"""Share of the views that may say otherwise of a point of the object, and share of the silhouettes that may
lie beside such points if masks are made well and poses are right."""


def with_masks(capture: Capture, network: str | Path | None = None, table: float | None = None) -> Capture:
    """The capture with a mask for every view: given ones stay, the others are made.

    What was made is compared: where most silhouettes agree on a solid, the parts of others that lie beside it
    are background, such as a cloth that the light falls on in some photographs.

    Args:
        capture: Photographs.
        network: Segmentation network as an ONNX file, such as ISNet or U²-Net: image (1, 3, h, w) in, mask in
            [0, 1] out. None: what differs from the background, whose colour the image's border shows.
        table: Height z of a level table [m, W]. Without a network, where the background is not plain, what
            stands on the table is found: the photographs are taken from around it.

    Raises:
        ValueError: If the background is not plain and there is neither network nor table, the masks come out
            empty, or nothing stands on the table.
        ImportError: If there is a network but no onnxruntime.
    """
    if all(view.mask is not None for view in capture.views):
        return capture
    on_table = network is None and table is not None and not all(map(is_plain, capture.views))
    if on_table:
        assert table is not None
        masks = standing_masks(capture.views, table)
    else:
        segment = background_mask if network is None else _Network(Path(network))
        masks = [segment(view) if view.mask is None else view.mask for view in capture.views]
    made = Capture(
        [
            view.replaced(mask=mask.astype(np.float32)) if view.mask is None else view
            for view, mask in zip(capture.views, masks, strict=True)
        ]
    )
    views = [
        cut_out(view.replaced(mask=view.mask * here)) if given.mask is None else given
        for given, view, here in zip(capture.views, made.views, _agreed(made), strict=True)
    ]
    if on_table:
        # These masks are a beginning: what colours of all photographs say goes beyond them.
        views = [
            view if given.mask is not None else _doubted(view, shown)
            for view, given, shown in zip(views, capture.views, _spared(views), strict=True)
        ]
    return Capture(views, capture.source)


def _doubted(view: View, shown: np.ndarray) -> View:
    """A view whose mask is doubted where a hull with photographs to spare says otherwise."""
    assert view.mask is not None
    return view.replaced(doubt=left_out(view.mask, shown))


def _spared(views: Sequence[View]) -> list[np.ndarray]:
    """Silhouettes of what all masks but a few leave."""
    train = [view for view in views if view.split == "train"]
    try:
        lower, upper = object_box(train)
        box = NodeGrid.around(lower, upper, 64)
        solid = hull_distance(train, box, _DOUBTED, spare=spare_of(len(train)))
    except ValueError:
        return [np.zeros(view.image.shape[:2], np.float32) for view in views]
    return [silhouette(view.camera, box, solid) for view in views]


def _agreed(capture: Capture) -> list[np.ndarray]:
    """For each view the pixels that may show what most silhouettes agree on; all if too few agree."""
    train, views = capture.split("train"), capture.views
    everything = [np.ones(view.image.shape[:2], bool) for view in views]
    try:
        lower, upper = object_box(train)
    except ValueError:
        # Poses or masks are wrong, which `survey` says in words.
        return everything
    box = NodeGrid.around(lower, upper, 64)
    _, cover = silhouettes(box.nodes, train, _DOUBTED)
    near = ndimage.binary_dilation((cover > 0.5).reshape(box.shape), iterations=2)
    kept, beside = [], []
    for view in views:
        here = np.zeros(view.image.shape[:2], bool)
        here.ravel()[rays_of(view.camera, None, box, near)[0]] = True
        kept.append(here)
        assert view.mask is not None
        beside.append(float(np.sum(view.mask * ~here) / max(np.sum(view.mask), 1.0)))
    return kept if np.median(beside) < _USUAL else everything


def background_mask(view: View) -> Float[np.ndarray, "height width"]:
    """What differs from a plain background: largest connected part, holes filled, edges soft over two pixels.

    Raises:
        ValueError: If the border of the image is of many colours.
    """
    image = view.image
    colour, away, spread = _against(image, _border(image))
    if spread > _PLAIN:
        raise ValueError(
            f"{view.name}: the background is not plain (its colours differ by {spread:.2f} from their median,"
            f" at most {_PLAIN} can be told from an object): give masks, a segmentation network, or the"
            " height of the table that the object stands on"
        )
    solid = _unlike(away, spread)
    if not solid.any():
        raise ValueError(f"{view.name}: nothing differs from the background, the mask would be empty")
    solid = ndimage.binary_fill_holes(largest_part(solid))
    assert solid is not None
    return _coverage(image, colour, solid)


def is_plain(view: View) -> bool:
    """Whether the border of a photograph is of one colour."""
    return _against(view.image, _border(view.image))[2] <= _PLAIN


def _border(image: np.ndarray) -> np.ndarray:
    rim = max(2, round(_BORDER * min(image.shape[:2])))
    border = np.ones(image.shape[:2], dtype=bool)
    border[rim:-rim, rim:-rim] = False
    return border


def _against(image: np.ndarray, outside: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Colour of the background that some pixels show, deviations from it everywhere, and its own, usually."""
    colour = np.median(image[outside], axis=0)
    away = np.abs(image - colour).max(axis=2)
    return colour, away, float(np.quantile(away[outside], 0.8))


def _unlike(away: np.ndarray, spread: float) -> np.ndarray:
    """Where deviations from a background's colour are too large to be those that it has itself, `spread`."""
    smooth = ndimage.gaussian_filter(away, 0.7)
    # A dimly lit cloth is darker than half the way to what is bright, which shadows on the object may not be.
    return smooth > max(4 * spread, 0.03, min(0.5 * _otsu(smooth), _CLEARLY_OBJECT))


def _completed(mask: np.ndarray, unlike: np.ndarray) -> np.ndarray:
    """A mask with holes and narrow bays filled where the photograph shows no background.

    Masks by a threshold leave out what lies in shadow, which cuts deep into the hull of all silhouettes.
    """
    solid = mask > 0.5
    reach = _BAY * float(np.sqrt(solid.sum()))
    pad = int(reach) + 2
    grown = ndimage.distance_transform_edt(~np.pad(solid, pad)) <= reach
    closed = (np.asarray(ndimage.distance_transform_edt(grown)) > reach)[pad:-pad, pad:-pad]
    missing = closed & unlike & ~solid
    # What is a pixel wide is the blur of an edge.
    missing = ndimage.binary_propagation(ndimage.binary_opening(missing), mask=missing)
    return np.maximum(mask, missing.astype(mask.dtype))


def _otsu(values: np.ndarray) -> float:
    """The value that splits others into the two groups that vary least within (Otsu 1979)."""
    counts, edges = np.histogram(values, 256)
    middle = 0.5 * (edges[1:] + edges[:-1])
    below, total = np.cumsum(counts)[:-1], counts.sum()
    mean_below = np.cumsum(counts * middle)[:-1] / np.maximum(below, 1)
    mean_above = (np.sum(counts * middle) - below * mean_below) / np.maximum(total - below, 1)
    between = below * (total - below) * (mean_above - mean_below) ** 2
    return float(middle[int(np.argmax(between))])


def _coverage(image: np.ndarray, background: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """How much of each pixel a solid covers: where its colour is between background and nearest core.

    A threshold low enough to find a dark object lies far out in the blur of its edge: taken as the outline it
    would make the object almost a pixel too large all around.
    """
    core = ndimage.binary_erosion(solid, iterations=2)
    if not core.any():
        return solid.astype(np.float32)
    nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    inner = image[tuple(np.asarray(nearest))] - background
    square = np.maximum(np.sum(inner**2, axis=2), 1e-4)
    share = np.clip(np.sum((image - background) * inner, axis=2) / square, 0, 1)
    rim = ndimage.binary_dilation(solid) & ~core
    return np.where(core, 1, np.where(rim, share, 0)).astype(np.float32)


class _Network:
    """A segmentation network, asked image by image."""

    def __init__(self, path: Path):
        if not path.is_file():
            raise ValueError(f"network must be an ONNX file, got {path}, which does not exist")
        onnxruntime = NETWORKS.load()
        try:
            self._session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has exceptions of its own, not derived from a common one
            raise ValueError(f"{path}: cannot be read as an ONNX network ({error})") from error
        self._input = self._session.get_inputs()[0]
        shape = self._input.shape
        if len(shape) != 4:
            raise ValueError(f"{path}: the network must take (1, 3, height, width), got {shape}")
        self._size = [n if isinstance(n, int) and n > 0 else 1024 for n in shape[2:]]

    def __call__(self, view: View) -> Float[np.ndarray, "height width"]:
        height, width = view.image.shape[:2]
        scale = (self._size[0] / height, self._size[1] / width, 1)
        pixels = ndimage.zoom(view.image, scale, order=1, mode="nearest", grid_mode=True)
        batch = (pixels - 0.5).transpose(2, 0, 1)[None].astype(np.float32)
        answer = np.squeeze(np.asarray(self._session.run(None, {self._input.name: batch})[0]))
        if answer.ndim != 2:
            raise ValueError(f"the network must return one mask, got shape {answer.shape} for {view.name}")
        if answer.min() < 0 or answer.max() > 1:
            answer = 1 / (1 + np.exp(-answer))
        back = (height / answer.shape[0], width / answer.shape[1])
        return np.clip(ndimage.zoom(answer, back, order=1, mode="nearest", grid_mode=True), 0, 1)


def cut_out(view: View) -> View:
    """The object alone, over black, if the background is plain: C − (1 − M) B, without B's share of the edge.

    Without this a dark background would leave a dark rim on every rendering, a bright one a bright rim. Holes
    and narrow bays of the mask are filled where the photograph shows no background, but shadows. A view whose
    background is not plain stays as it is.
    """
    if view.mask is None or view.cut_out:
        return view
    outside = ndimage.binary_erosion(view.mask < 0.02, iterations=2)
    if outside.sum() < 50:
        return view
    background, away, spread = _against(view.image, outside)
    if spread > _PLAIN:
        return view
    mask = _completed(view.mask, _unlike(away, spread))
    alone = np.clip(view.image - (1 - mask[..., None]) * background, 0, mask[..., None])
    return view.replaced(
        image=alone.astype(np.float32), mask=mask, cut_out=True, background=background.astype(np.float64)
    )


def check_masks(views: Sequence[View]) -> None:
    """Check that masks show something, and not everything.

    Raises:
        ValueError: If masks are empty or full; the message names the views.
    """
    empty = [view.name for view in views if view.mask is not None and not np.any(view.mask > 0.5)]
    full = [view.name for view in views if view.mask is not None and np.all(view.mask > 0.5)]
    for what, names in (("show nothing of the object", empty), ("cover the whole image", full)):
        if names:
            raise ValueError(f"masks must show the object, but {len(names)} {what}: {', '.join(names[:4])}")
