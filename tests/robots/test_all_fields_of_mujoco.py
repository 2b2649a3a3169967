"""Every field of MuJoCo's model is read, refused by name, said, or changes no motion: none is overlooked."""

import dataclasses
import re

import numpy as np
import pytest

import dano
from dano.robots import read_robot

mujoco = pytest.importorskip("mujoco")

FILE = """<mujoco><compiler angle="radian"/>{option}<worldbody>
<geom name="floor" type="plane" size="1 1 1" {floor}/>
<body name="a" pos="0 0 1" {body}>{free}<joint name="j" axis="0 1 0" {joint}/>
 <geom name="g" type="box" size=".2 .02 .02" {geom}/>
 <body name="b" pos=".4 0 0"><joint name="k" axis="0 1 0"/><geom name="h" size=".05" pos=".1 0 0"/>
  <body name="c" pos=".4 0 0"><joint name="l" axis="0 1 0"/><geom name="i" size=".05" pos=".1 0 0"/></body>
 </body></body>{world}</worldbody>{after}</mujoco>"""
PARTS = ("option", "floor", "body", "free", "joint", "geom", "world", "after")


def written(tmp_path, **parts: str):
    path = tmp_path / "file.xml"
    path.write_text(FILE.format(**{name: parts.get(name, "") for name in PARTS}), encoding="utf-8")
    return path


def summary(path) -> dict:
    """All that a description says, comparable."""
    described = dataclasses.asdict(read_robot(path))

    def plain(x):
        if isinstance(x, dict):
            return {str(key): plain(value) for key, value in x.items()}
        if isinstance(x, (list, tuple)):
            return [plain(y) for y in x]
        return x.tolist() if isinstance(x, np.ndarray) else x

    return {key: plain(value) for key, value in described.items() if key not in ("source", "name")}


MOTOR = '<actuator><motor name="m" joint="j" {}/></actuator>'
GENERAL = '<actuator><general name="m" joint="j" {}/></actuator>'
PAIR = '<contact><pair geom1="floor" geom2="g" {}/></contact>'
EQUALITY = '<equality><joint joint1="j" joint2="k" {}/></equality>'
TENDON = '<tendon><fixed name="t" {}><joint joint="j" coef="1"/></fixed></tendon>'
# What each field is set by, and to what it is compared; both files must not say the same to dano.
SET = {
    "body_pos": (
        {"world": '<body name="w" pos="1 0 0"><geom size=".1"/></body>'},
        {"world": '<body name="w"><geom size=".1"/></body>'},
    ),
    "body_quat": ({"body": 'euler="0 1 0"'}, {}),
    "body_mass": ({"geom": 'mass="2"'}, {}),
    "body_ipos": ({"geom": 'pos=".1 0 0"'}, {}),
    "body_inertia": ({"geom": 'density="7"'}, {}),
    "body_gravcomp": ({"body": 'gravcomp="1"'}, {}),
    "body_mocapid": (
        {"world": '<body name="w" mocap="true"><geom size=".1"/></body>'},
        {"world": '<body name="w"><geom size=".1"/></body>'},
    ),
    "jnt_type": ({"joint": 'type="slide"'}, {}),
    "jnt_axis": (
        {"world": '<body name="w"><joint name="x" axis="1 0 0"/><geom size=".1"/></body>'},
        {"world": '<body name="w"><joint name="x"/><geom size=".1"/></body>'},
    ),
    "jnt_pos": ({"joint": 'pos=".1 0 0"'}, {}),
    "jnt_limited": ({"joint": 'range="-1 1" limited="true"'}, {}),
    "jnt_stiffness": ({"joint": 'stiffness="3"'}, {}),
    "jnt_stiffnesspoly": ({"joint": 'stiffness="3 1 1"'}, {"joint": 'stiffness="3"'}),
    "qpos_spring": ({"joint": 'stiffness="3" springref=".3"'}, {"joint": 'stiffness="3"'}),
    "qpos0": ({"joint": 'ref=".3"'}, {}),
    "jnt_actfrcrange": ({"joint": 'actuatorfrcrange="-1 2"'}, {"joint": 'actuatorfrcrange="-2 2"'}),
    "jnt_actfrclimited": ({"joint": 'actuatorfrcrange="-1 2"'}, {}),
    "jnt_actgravcomp": ({"joint": 'actuatorgravcomp="true"'}, {}),
    "dof_damping": ({"joint": 'damping="3"'}, {}),
    "dof_dampingpoly": ({"joint": 'damping="3 1 1"'}, {"joint": 'damping="3"'}),
    "dof_frictionloss": ({"joint": 'frictionloss="3"'}, {}),
    "dof_armature": ({"joint": 'armature="3"'}, {}),
    "geom_pos": ({"geom": 'pos=".1 0 0" mass="1"'}, {"geom": 'mass="1"'}),
    "geom_quat": ({"geom": 'euler="0 1 0"'}, {}),
    "geom_size": ({"floor": 'pos="0 0 1"'}, {}),
    "geom_contype": ({"geom": 'contype="2" conaffinity="0"'}, {"geom": 'conaffinity="0"'}),
    "geom_conaffinity": ({"geom": 'conaffinity="2" contype="0"'}, {"geom": 'contype="0"'}),
    "geom_condim": ({"geom": 'condim="1"', "floor": 'condim="1"'}, {}),
    "geom_condim more": ({"geom": 'condim="6"'}, {}),
    "geom_friction": ({"geom": 'friction="3"'}, {}),
    "geom_priority": ({"geom": 'friction=".1" priority="1"'}, {"geom": 'friction=".1"'}),
    "geom_solref": ({"geom": 'solref=".1 1"'}, {}),
    "geom_solimp": ({"geom": 'solimp=".5 .6"'}, {}),
    "geom_margin": ({"geom": 'margin=".1"'}, {}),
    "geom_gap": ({"geom": 'gap=".1"'}, {}),
    "geom_surfacevel": ({"geom": 'surfacevel="1 0 0"'}, {}),
    "geom_adhesion": ({"geom": 'adhesion="1"'}, {}),
    "pair_friction": ({"after": PAIR.format('friction=".1 .1"')}, {"after": PAIR.format("")}),
    "pair_friction uneven": ({"after": PAIR.format('friction="1 .1"')}, {"after": PAIR.format("")}),
    "pair_dim": ({"after": PAIR.format('condim="1"')}, {"after": PAIR.format("")}),
    "pair_geom1": ({"after": PAIR.replace('"floor"', '"i"').format("")}, {}),
    "pair_margin": ({"after": PAIR.format('margin=".1"')}, {"after": PAIR.format("")}),
    "pair_gap": ({"after": PAIR.format('gap=".1"')}, {"after": PAIR.format("")}),
    "pair_solref": ({"after": PAIR.format('solref=".1 1"')}, {"after": PAIR.format("")}),
    "pair_solimp": ({"after": PAIR.format('solimp=".5 .6"')}, {"after": PAIR.format("")}),
    "pair_adhesion": ({"after": PAIR.format('adhesion="1"')}, {"after": PAIR.format("")}),
    "exclude_signature": ({"after": '<contact><exclude body1="world" body2="a"/></contact>'}, {}),
    "eq_type": ({"after": EQUALITY.format("")}, {}),
    "eq_data": ({"after": EQUALITY.format('polycoef="0 2"')}, {"after": EQUALITY.format("")}),
    "eq_active0": ({"after": EQUALITY.format('active="false"')}, {"after": EQUALITY.format("")}),
    "eq tendon": ({"after": TENDON.format("") + '<equality><tendon tendon1="t"/></equality>'}, {}),
    "actuator_gear": ({"after": MOTOR.format('gear="2"')}, {"after": MOTOR.format("")}),
    "actuator_forcerange": ({"after": MOTOR.format('forcerange="-1 1"')}, {"after": MOTOR.format("")}),
    "actuator_ctrlrange": ({"after": MOTOR.format('ctrlrange="-1 1"')}, {"after": MOTOR.format("")}),
    "actuator_gainprm": ({"after": GENERAL.format('gainprm="3"')}, {"after": GENERAL.format("")}),
    "actuator_biasprm": (
        {"after": GENERAL.format('gainprm="3" biastype="affine" biasprm="0 -3 0"')},
        {"after": GENERAL.format('gainprm="3"')},
    ),
    "actuator_dyntype": ({"after": GENERAL.format('dyntype="integrator"')}, {"after": GENERAL.format("")}),
    "actuator_armature": ({"after": MOTOR.format('armature="1"')}, {"after": MOTOR.format("")}),
    "actuator_damping": ({"after": MOTOR.format('damping="1"')}, {"after": MOTOR.format("")}),
    "actuator_delay": ({"after": MOTOR.format('delay=".1" nsample="5"')}, {"after": MOTOR.format("")}),
    "actuator_trntype": (
        {"after": TENDON.format("") + '<actuator><motor tendon="t"/></actuator>'},
        {"after": TENDON.format("")},
    ),
    "tendon_stiffness": ({"after": TENDON.format('stiffness="1"')}, {}),
    "tendon_damping": ({"after": TENDON.format('damping="1"')}, {}),
    "tendon_frictionloss": ({"after": TENDON.format('frictionloss="1"')}, {}),
    "tendon_armature": ({"after": TENDON.format('armature="1"')}, {}),
    "tendon_limited": ({"after": TENDON.format('range="-1 1" limited="true"')}, {}),
    "key_qpos": ({"after": '<keyframe><key name="up" qpos="1 0 0"/></keyframe>'}, {}),
    "gravity": ({"option": '<option gravity="0 0 -1"/>'}, {}),
    "density": ({"option": '<option density="1"/>'}, {}),
    "viscosity": ({"option": '<option viscosity="1"/>'}, {}),
    "o_friction": (
        {"option": '<option o_friction=".1 .1"><flag override="enable"/></option>'},
        {"option": '<option><flag override="enable"/></option>'},
    ),
    "flag override": ({"option": '<option><flag override="enable"/></option>'}, {}),
    "flag constraint": ({"option": '<option><flag constraint="disable"/></option>'}, {}),
    "flag contact": ({"option": '<option><flag contact="disable"/></option>'}, {}),
    "flag gravity": ({"option": '<option><flag gravity="disable"/></option>'}, {}),
    "flag filterparent": ({"option": '<option><flag filterparent="disable"/></option>'}, {}),
    "flag limit": (
        {"option": '<option><flag limit="disable"/></option>', "joint": 'range="-1 1"'},
        {"joint": 'range="-1 1"'},
    ),
    "flag damper": (
        {"option": '<option><flag damper="disable"/></option>', "joint": 'damping="1"'},
        {"joint": 'damping="1"'},
    ),
    "flag spring": (
        {"option": '<option><flag spring="disable"/></option>', "joint": 'stiffness="1"'},
        {"joint": 'stiffness="1"'},
    ),
    "flag frictionloss": (
        {"option": '<option><flag frictionloss="disable"/></option>', "joint": 'frictionloss="1"'},
        {"joint": 'frictionloss="1"'},
    ),
    "flag actuation": (
        {"option": '<option><flag actuation="disable"/></option>', "after": MOTOR.format("")},
        {"after": MOTOR.format("")},
    ),
    "flag clampctrl": (
        {"option": '<option><flag clampctrl="disable"/></option>', "after": MOTOR.format('ctrlrange="-1 1"')},
        {"after": MOTOR.format('ctrlrange="-1 1"')},
    ),
    "flag equality": (
        {"option": '<option><flag equality="disable"/></option>', "after": EQUALITY.format("")},
        {"after": EQUALITY.format("")},
    ),
    "disableactuator": (
        {"option": '<option actuatorgroupdisable="2"/>', "after": MOTOR.format('group="2"')},
        {"after": MOTOR.format("")},
    ),
}


@pytest.mark.parametrize("field", SET)
def test_what_a_field_changes_is_read_refused_or_said(tmp_path, field: str):
    given, usual = SET[field]
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    told, plain = summary(written(tmp_path / "one", **given)), summary(written(tmp_path / "other", **usual))
    assert told != plain


# What is only seen, named, counted, kept for users, or follows from other fields; and what only says how
# exactly, or how fast, MuJoCo solves. None of it changes what a file describes.
OF_NO_MOTION = (
    r"n[A-Z_a-z0-9]+|.*_user|user_.*|.*_rgba|.*_matid|.*_group|.*adr|paths"
    r"|B_.*|D_.*|M_.*|mapD2M|mapM2D|mapM2M|efm.*|flexedge_.*|ten_J.*|bvh_.*|oct_.*|tree_.*|cam_.*|light_.*|mat_.*"
    r"|tex_.*|skin_.*|text_.*|tuple_.*|numeric_.*|sensor_.*|site_.*|vis|stat|signature|flg_.*|.*_sameframe"
    r"|.*invweight0|.*_bvh.*|.*_treeid|mesh_.*|.*_M0|geom_aabb|geom_rbound|geom_castshadow|dof_length|dof_parentid"
    r"|dof_simplenum|dof_bodyid|dof_jntid|body_subtreemass|body_rootid|body_weldid|body_simple|body_contype"
    r"|body_conaffinity|body_margin|body_.*num|jnt_bodyid|jnt_actuatorid|actuator_acc0|actuator_length0"
    r"|actuator_.*num|actuator_history|actuator_ctrlspec|tendon_length0|tendon_width|tendon_tree.*|tendon_num"
    r"|tendon_actuatorid|pair_signature|pair_solreffriction|hfield_.*|plugin.*"
)
# Read, refused or said where another field of the same thing is: the test above sets that one.
WITH_OTHERS = {
    "read beside": """body_parentid body_iquat jnt_range geom_type geom_bodyid geom_dataid pair_geom2
        eq_obj1id eq_obj2id eq_objtype actuator_trnid actuator_gaintype actuator_biastype actuator_ctrllimited
        actuator_forcelimited key_qvel opt""",
    "refused with it": """geom_fluid geom_plugin body_plugin actuator_plugin actuator_actlimited
        actuator_actrange actuator_actearly actuator_dynprm actuator_cranklength actuator_lengthrange
        actuator_dampingpoly jnt_springyield tendon_actfrclimited tendon_actfrcrange tendon_range
        tendon_lengthspring tendon_margin
        tendon_type tendon_dampingpoly tendon_stiffnesspoly tendon_springyield tendon_solimp_fri
        tendon_solimp_lim tendon_solref_fri tendon_solref_lim wrap_objid wrap_prm wrap_type""",
    "said with contacts": "geom_solmix",
    # Constraints of joints and equalities are hard in dano, which docs/robots.md says.
    "hard in dano": "jnt_solimp jnt_solref jnt_margin dof_solimp dof_solref eq_solimp eq_solref",
    "states that dano has not": "key_act key_ctrl key_mpos key_mquat key_plastic key_time",
}
# How MuJoCo solves, and what only sensors or drag (refused) read.
OPTIONS = """ccd_iterations ccd_tolerance cone enableflags disableflags impratio integrator iterations
    jacobian ls_iterations ls_tolerance magnetic noslip_iterations noslip_tolerance sdf_initpoints
    sdf_iterations sleep_tolerance solver timestep tolerance wind o_margin o_solimp o_solref"""
DISABLED = """WARMSTART REFSAFE SENSOR MIDPHASE EULERDAMP AUTORESET NATIVECCD ISLAND MULTICCD"""
ENABLED = """ENERGY FWDINV INVDISCRETE SLEEP DIAGEXACT IPC SPECULATIVE"""


def test_no_field_of_the_model_is_overlooked():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    names = [x for x in dir(model) if not x.startswith("_") and not callable(getattr(model, x))]
    known = {name.split()[0] for name in SET} | {x for text in WITH_OTHERS.values() for x in text.split()}
    pattern = re.compile(OF_NO_MOTION)
    unknown = [x for x in names if x not in known and not pattern.fullmatch(x) and not x.startswith("flex")]
    assert unknown == []


def test_no_option_and_no_flag_is_overlooked():
    option = mujoco.MjOption()
    known = {name.split()[0] for name in SET} | set(OPTIONS.split())
    assert [x for x in dir(option) if not x.startswith("_") and x not in known] == []
    flags = {name.split()[1].upper() for name in SET if name.startswith("flag ")}
    disabled = {x.removeprefix("mjDSBL_") for x in mujoco.mjtDisableBit.__members__ if "_" in x}
    enabled = {x.removeprefix("mjENBL_") for x in mujoco.mjtEnableBit.__members__ if "_" in x}
    assert disabled - flags - set(DISABLED.split()) == set()
    assert enabled - flags - set(ENABLED.split()) == set()


def test_masks_are_those_of_mujoco(tmp_path):
    """Pairs that a robot and its world may touch with are those that MuJoCo finds, put into one place."""
    path = written(
        tmp_path,
        geom='contype="2" conaffinity="1"',
        floor='contype="1" conaffinity="4"',
        world='<body name="w"><freejoint/><geom name="x" size="3" contype="4" conaffinity="2"/></body>',
        after='<contact><exclude body1="c" body2="w"/></contact>',
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    name = lambda g: model.body(model.geom_bodyid[g]).name or "floor"  # noqa: E731
    name = lambda g, name=name: "floor" if name(g) == "world" else name(g)  # noqa: E731
    found = {frozenset((name(c.geom[0]), name(c.geom[1]))) for c in data.contact}
    meets = read_robot(path).meets
    assert meets is not None and found and found <= set(meets)
    robot = dano.load_mjcf(path)
    assert {frozenset(pair) for pair in robot.scene().pairs} == {
        pair for pair in meets if "w" in pair or "floor" in pair
    }
