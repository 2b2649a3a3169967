"""Simulate what robots see: neural density fields as rigid bodies, without a mesh in between."""

import importlib as _importlib
from typing import Any as _Any

from dano.maths import Pose as Pose  # isort: skip
from dano.fields import (
    AbstractField as AbstractField,
    AbstractShape as AbstractShape,
    bake as bake,
    Box as Box,
    CallableField as CallableField,
    Capsule as Capsule,
    Cylinder as Cylinder,
    Ellipsoid as Ellipsoid,
    GridField as GridField,
    HalfSpace as HalfSpace,
    load_field as load_field,
    mesh_field as mesh_field,
    posed as posed,
    save_field as save_field,
    scaled as scaled,
    Sphere as Sphere,
    union as union,
)
from dano.objects import (
    ContactSamples as ContactSamples,
    MassProperties as MassProperties,
    NeuralObject as NeuralObject,
    SurfaceSamples as SurfaceSamples,
)
from dano.contact import (
    AbstractContactLaw as AbstractContactLaw,
    CentroidLaw as CentroidLaw,
    ContactParams as ContactParams,
    Distance as Distance,
    distance as distance,
    DistributedLaw as DistributedLaw,
    Patch as Patch,
)
from dano.scene import (
    Body as Body,
    BodyMotion as BodyMotion,
    Contact as Contact,
    Control as Control,
    Frames as Frames,
    Joint as Joint,
    Loop as Loop,
    Motor as Motor,
    Others as Others,
    Scene as Scene,
    State as State,
    Trajectory as Trajectory,
)
from dano.robots import (
    bias_forces as bias_forces,
    computed_torque as computed_torque,
    gravity_forces as gravity_forces,
    close_loops as close_loops,
    inverse_kinematics as inverse_kinematics,
    InverseKinematics as InverseKinematics,
    joint_control as joint_control,
    JointPD as JointPD,
    joint_reactions as joint_reactions,
    load_mjcf as load_mjcf,
    load_urdf as load_urdf,
    mass_matrix as mass_matrix,
    operational_space_torque as operational_space_torque,
    pd as pd,
    Robot as Robot,
    Target as Target,
)
from dano.engine import (
    AbstractEngine as AbstractEngine,
    compiler_options as compiler_options,
    contact_history as contact_history,
    contact_patches as contact_patches,
    contact_wrenches as contact_wrenches,
    linearize as linearize,
    load_rollouts as load_rollouts,
    Rollouts as Rollouts,
    rollouts as rollouts,
    simulate as simulate,
    step as step,
    StoredRollouts as StoredRollouts,
    Touch as Touch,
    VariationalEngine as VariationalEngine,
)
from dano.identification import (
    Identification as Identification,
    identify as identify,
    identify_load as identify_load,
    identify_load_on_arm as identify_load_on_arm,
    IdentifyOptions as IdentifyOptions,
    JointLog as JointLog,
    Load as Load,
    load_motion as load_motion,
    load_wrist_log as load_wrist_log,
    Motion as Motion,
    motion_of_joints as motion_of_joints,
    Parameter as Parameter,
    save_motion as save_motion,
    WristLog as WristLog,
)
from dano.planning import (
    Actuator as Actuator,
    Execution as Execution,
    follow as follow,
    Goal as Goal,
    Limit as Limit,
    Plan as Plan,
    plan as plan,
    PlanOptions as PlanOptions,
    Replanning as Replanning,
    SamplingOptions as SamplingOptions,
    Task as Task,
)
from dano.scene_file import (
    build_parts as build_parts,
    load_object as load_object,
    load_scene as load_scene,
    Part as Part,
)
from dano.exchange import export_object as export_object, export_robot as export_robot

from dano.names import keep_old_name as _keep_old_name
import dano.fields as _fields
import dano.scene as _scene

__version__ = "0.1.0"

_PACKAGES = ("cli", "comparison", "gym", "learning", "mujoco", "pixels", "report", "vision")
"""Packages that `dano.` finds when they are first asked for: what they need is large, or optional."""


def __getattr__(name: str) -> _Any:
    if name in _PACKAGES:
        return _importlib.import_module(f"dano.{name}")
    raise AttributeError(f"module 'dano' has no attribute {name!r}")


# Scenes do not know reports, which are above them, and importing dano imports none.
_scene.offer(
    "film", lambda *given, **options: _importlib.import_module("dano.report").film_run(*given, **options)
)
_scene.offer("show", lambda *given: _importlib.import_module("dano.report").show_run(*given))
# Nor do fields know what photographs teach.
_fields.offer_learned(lambda path: _importlib.import_module("dano.vision.radiance").LearnedField.load(path))
_keep_old_name("dano.identify", "dano.identification")
_keep_old_name("dano.plan", "dano.planning")
