"""Cameras from photographs: structure from motion, scale and up, and what to say when it fails."""

from dano.vision.structure._diagnosis import BLURRED as BLURRED, only_turned as only_turned
from dano.vision.structure._estimate import (
    estimate_poses as estimate_poses,
    EstimatedPoses as EstimatedPoses,
    PosedPicture as PosedPicture,
)
from dano.vision.structure._file import save_transforms as save_transforms
from dano.vision.structure._gauge import Scale as Scale, Up as Up
from dano.vision.structure._markers import (
    detect_markers as detect_markers,
    FEWEST_VIEWS as FEWEST_VIEWS,
    PlacedMarker as PlacedMarker,
)
from dano.vision.structure._options import (
    FEWEST as FEWEST,
    KnownLength as KnownLength,
    PoseOptions as PoseOptions,
)
from dano.vision.structure._photographs import (
    mask_folder as mask_folder,
    Photograph as Photograph,
    picture_files as picture_files,
    read_photograph as read_photograph,
    VIDEOS as VIDEOS,
)
from dano.vision.structure._sharpness import blur as blur
from dano.vision.structure._similarity import pose_errors as pose_errors, PoseErrors as PoseErrors
from dano.vision.structure._video import (
    is_video as is_video,
    stretch as stretch,
    timed_frames as timed_frames,
    write_frames as write_frames,
)
