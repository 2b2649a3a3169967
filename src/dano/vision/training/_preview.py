"""What training has learned so far, as pictures beside the photographs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dano.archive import replacing
from dano.extras import optional

# Height to which small pictures are enlarged, and space between pictures [pixels] (convention).
_LEAST_HEIGHT = 96
_GAP = 2


def checked_folder(folder: str | Path) -> Path:
    """A folder for previews, made if its parent exists.

    Raises:
        ValueError: If it is a file, or its parent does not exist.
        ImportError: If pillow is missing.
    """
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ValueError(f"previews must be a folder, got the file {path}")
    if not path.parent.is_dir():
        raise ValueError(f"previews must be in an existing folder, got {path} in missing {path.parent}")
    optional("PIL", "previews need pillow", "train")
    path.mkdir(exist_ok=True)
    return path


def write_preview(
    path: Path,
    pairs: Sequence[tuple[Float[np.ndarray, "_ _ 3"], Float[np.ndarray, "_ _ 3"]]],
) -> None:
    """Write a PNG: photographs in a row, their renderings below them, enlarged if they are small.

    Args:
        path: The file, replaced only when complete.
        pairs: Photograph and rendering as sRGB in [0, 1], of one size each; pairs may differ in size.
    """
    from PIL import Image  # pyright: ignore[reportMissingImports]

    columns = []
    for pair in pairs:
        times = -(-_LEAST_HEIGHT // pair[0].shape[0])
        columns.append([np.repeat(np.repeat(x, times, axis=0), times, axis=1) for x in pair])
    height = max(wanted.shape[0] for wanted, _ in columns)
    width = sum(wanted.shape[1] + _GAP for wanted, _ in columns) - _GAP
    sheet = np.ones((2 * height + _GAP, width, 3), dtype=np.float32)
    left = 0
    for column in columns:
        for row, image in enumerate(column):
            top = row * (height + _GAP)
            sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
        left += column[0].shape[1] + _GAP
    with replacing(path) as file:
        Image.fromarray(np.rint(255 * np.clip(sheet, 0, 1)).astype(np.uint8)).save(file, format="PNG")
