"""Scenes: what exists, what may touch, and the states it moves through."""

from dano.scene._bodies import Body as Body, pressing_pairs as pressing_pairs
from dano.scene._contacts import colliders as colliders, Contact as Contact
from dano.scene._doubts import (
    box_volume as box_volume,
    say_doubts as say_doubts,
    SceneDoubt as SceneDoubt,
    SceneWarning as SceneWarning,
)
from dano.scene._frames import (
    BodyPoses as BodyPoses,
    Chains as Chains,
    filled as filled,
    Frames as Frames,
    joints_of as joints_of,
    link_jacobian as link_jacobian,
    place_links as place_links,
    plane_axes as plane_axes,
    RESOLVED as RESOLVED,
    step_twists as step_twists,
    triples as triples,
)
from dano.scene._joints import (
    Joint as Joint,
    JOINT_KINDS as JOINT_KINDS,
    JointLaws as JointLaws,
    Loop as Loop,
    LOOP_KINDS as LOOP_KINDS,
    Loops as Loops,
    Motor as Motor,
    MOTOR_KINDS as MOTOR_KINDS,
    StateLayout as StateLayout,
)
from dano.scene._others import (
    Others as Others,
    touching_pairs as touching_pairs,
    unnamed_contacts as unnamed_contacts,
)
from dano.scene._scene import lifted as lifted, pulls as pulls, Scene as Scene
from dano.scene._states import (
    BodyMotion as BodyMotion,
    coming_from as coming_from,
    Control as Control,
    JOINT_QUANTITIES as JOINT_QUANTITIES,
    offer as offer,
    Origin as Origin,
    State as State,
    state_arrays as state_arrays,
    STATE_SIZES as STATE_SIZES,
    Trajectory as Trajectory,
)
