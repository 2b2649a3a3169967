"""From photographs to a field: what they can tell, the steps of training, cavities, scores."""

from dano.vision.training._metrics import mask_iou as mask_iou, psnr as psnr, ssim as ssim
from dano.vision.training._options import TrainOptions as TrainOptions
from dano.vision.training._score import Score as Score, score as score
from dano.vision.training._survey import (
    Survey as Survey,
    survey as survey,
    visual_hull as visual_hull,
)
from dano.vision.training._train import (
    HistoryEntry as HistoryEntry,
    train as train,
    Trained as Trained,
    volume as volume,
)
