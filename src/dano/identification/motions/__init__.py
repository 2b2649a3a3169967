"""Observed motions of bodies, and their files."""

from dano.identification.motions._motion import (
    JOINT_NUMBERS as JOINT_NUMBERS,
    joint_numbers as joint_numbers,
    joint_table as joint_table,
    joint_widths as joint_widths,
    Motion as Motion,
    motion_of_joints as motion_of_joints,
    QUANTITIES as QUANTITIES,
    SMOOTHING_FRAMES as SMOOTHING_FRAMES,
    UNNAMED as UNNAMED,
)
from dano.identification.motions._motion_files import load_motion as load_motion, save_motion as save_motion
