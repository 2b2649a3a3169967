"""What a robot holds, from what its wrist feels: mass, centre and inertia from forces and torques."""

from dano.identification.wrench._estimate import Load as Load
from dano.identification.wrench._fit import (
    identify_load as identify_load,
    identify_load_on_arm as identify_load_on_arm,
    JointLog as JointLog,
)
from dano.identification.wrench._log import load_wrist_log as load_wrist_log, WristLog as WristLog
