"""Cameras, photographs and what is learned from them, pictures of fields. Knows nothing of physics."""

from dano.vision._appearance import Appearance as Appearance, Network as Network
from dano.vision._camera import (
    AbstractCamera as AbstractCamera,
    Camera as Camera,
    PosedCamera as PosedCamera,
)
from dano.vision._capture import Capture as Capture, View as View
from dano.vision._capture_files import load_capture as load_capture
from dano.vision._composed import compose as compose
from dano.vision._hash_model import HashModel as HashModel
from dano.vision._hull import Box as Box, hull_distance as hull_distance
from dano.vision._item import (
    checked_colour as checked_colour,
    Item as Item,
    level_surface as level_surface,
    PALETTE as PALETTE,
    placement as placement,
)
from dano.vision._learned import LearnedField as LearnedField
from dano.vision._light import Light as Light
from dano.vision._masks import background_mask as background_mask, with_masks as with_masks
from dano.vision._metrics import mask_iou as mask_iou, psnr as psnr, ssim as ssim
from dano.vision._models import (
    AbstractMedium as AbstractMedium,
    AbstractModel as AbstractModel,
    DensityModel as DensityModel,
    Rays as Rays,
    Sampling as Sampling,
    see as see,
    Seen as Seen,
    SurfaceModel as SurfaceModel,
)
from dano.vision._options import TrainOptions as TrainOptions
from dano.vision._osf import OSF as OSF
from dano.vision._picture import Picture as Picture, picture as picture
from dano.vision._render import render as render
from dano.vision._score import Score as Score, score as score
from dano.vision._survey import Survey as Survey, survey as survey
from dano.vision._train import (
    Progress as Progress,
    train as train,
    Trained as Trained,
    volume as volume,
)
