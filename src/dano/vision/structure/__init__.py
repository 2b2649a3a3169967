"""Cameras from photographs: structure from motion, scale and up, and what to say when it fails."""

from dano.vision.structure._estimate import (
    estimate_poses as estimate_poses,
    EstimatedPoses as EstimatedPoses,
    PosedPicture as PosedPicture,
)
from dano.vision.structure._file import save_transforms as save_transforms
from dano.vision.structure._gauge import Scale as Scale, Up as Up
from dano.vision.structure._markers import PlacedMarker as PlacedMarker
from dano.vision.structure._options import KnownLength as KnownLength, PoseOptions as PoseOptions
from dano.vision.structure._photographs import picture_files as picture_files, VIDEOS as VIDEOS
from dano.vision.structure._similarity import pose_errors as pose_errors, PoseErrors as PoseErrors
from dano.vision.structure._video import stretch as stretch, timed_frames as timed_frames
