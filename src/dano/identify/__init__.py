"""Identification: from observed motions to the parameters of a scene, with error bars."""

from dano.identify._identify import identify as identify
from dano.identify._motion import Motion as Motion, motion_of_joints as motion_of_joints
from dano.identify._motion_files import load_motion as load_motion, save_motion as save_motion
from dano.identify._parameters import Parameter as Parameter
from dano.identify._result import Errors as Errors, Identification as Identification, Minimum as Minimum
from dano.identify._settings import IdentifyOptions as IdentifyOptions
