"""Cameras from photographs: structure from motion, scale and up, and what to say when it fails."""

from dano.vision.structure._diagnosis import BLURRED as BLURRED, only_turned as only_turned
from dano.vision.structure._estimate import (
    estimate_poses as estimate_poses,
    EstimatedPoses as EstimatedPoses,
    PosedPicture as PosedPicture,
    save_transforms as save_transforms,
)
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
    blur as blur,
    is_video as is_video,
    mask_folder as mask_folder,
    Photograph as Photograph,
    picture_files as picture_files,
    read_photograph as read_photograph,
    stretch as stretch,
    timed_frames as timed_frames,
    VIDEOS as VIDEOS,
    write_frames as write_frames,
)
from dano.vision.structure._similarity import pose_errors as pose_errors, PoseErrors as PoseErrors
