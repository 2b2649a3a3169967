"""Identification: from observed motions to the parameters of a scene, with error bars."""

from dano.identification._identify import identify as identify
from dano.identification._settings import (
    IdentifyOptions as IdentifyOptions,
    Parameter as Parameter,
    parameter_of as parameter_of,
)
from dano.identification._uncertainty import (
    Errors as Errors,
    Identification as Identification,
    Minimum as Minimum,
)
from dano.identification.motions import (
    load_motion as load_motion,
    Motion as Motion,
    motion_of_joints as motion_of_joints,
    save_motion as save_motion,
)
from dano.identification.wrench import (
    identify_load as identify_load,
    identify_load_on_arm as identify_load_on_arm,
    JointLog as JointLog,
    Load as Load,
    load_wrist_log as load_wrist_log,
    WristLog as WristLog,
)
