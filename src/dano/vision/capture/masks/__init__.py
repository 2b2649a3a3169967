"""What in photographs is the object: masks that are made, doubts about them, what is behind the object."""

from dano.vision.capture.masks._decided import (
    decided_by_colours as decided_by_colours,
    left_out as left_out,
    Solid as Solid,
)
from dano.vision.capture.masks._made import (
    background_mask as background_mask,
    check_masks as check_masks,
    cut_out as cut_out,
    is_plain as is_plain,
    with_masks as with_masks,
)
