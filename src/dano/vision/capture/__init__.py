"""Photographs from known places: cameras, files, masks, silhouettes, and the rays that see an object."""

from dano.vision.capture._camera import (
    AbstractCamera as AbstractCamera,
    Camera as Camera,
    PosedCamera as PosedCamera,
)
from dano.vision.capture._capture import Capture as Capture, View as View
from dano.vision.capture._capture_files import load_camera as load_camera, load_capture as load_capture
from dano.vision.capture._hull import (
    hull_distance as hull_distance,
    object_box as object_box,
    spare_of as spare_of,
    viewed_ball as viewed_ball,
)
from dano.vision.capture._light import Light as Light
from dano.vision.capture._node_grid import NodeGrid as NodeGrid, resampled as resampled
from dano.vision.capture._pictures import (
    picture_files as picture_files,
    PICTURES as PICTURES,
    read_mask as read_mask,
    read_picture as read_picture,
)
from dano.vision.capture._ray_set import (
    collect as collect,
    rays_of as rays_of,
    RaySet as RaySet,
)
from dano.vision.capture._rays import box_interval as box_interval, Rays as Rays
from dano.vision.capture._shown import silhouette as silhouette
from dano.vision.capture.masks import (
    background_mask as background_mask,
    check_masks as check_masks,
    decided_by_colours as decided_by_colours,
    is_plain as is_plain,
    left_out as left_out,
    Solid as Solid,
    with_masks as with_masks,
)
