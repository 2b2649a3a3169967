"""MuJoCo's own format."""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from dano.exchange._triangles import Contents, MESHES, PLAIN, VISUAL, words

NOTES = (
    "MuJoCo: contact is with the convex pieces and as soft as its own defaults (solref, solimp). It has no"
    " coefficient of restitution.",
    'MuJoCo: the friction is that of this object whatever it touches (priority="1"); of two such objects the'
    " larger one counts.",
)

_COARSE = ("torsional_friction", "rolling_friction")


def write_mjcf(folder: Path, contents: Contents) -> list[str]:
    """Write `NAME.xml`, the object, and `scene.xml`, the object over a floor; names of the files."""
    name = contents.name
    (folder / f"{name}.xml").write_text(_object(contents), encoding="utf-8")
    (folder / "scene.xml").write_text(_scene(contents), encoding="utf-8")
    return [f"{name}.xml", "scene.xml"]


def _object(contents: Contents) -> str:
    name, inertia = contents.name, contents.inertia
    # MuJoCo wants xx yy zz xy xz yz.
    tensor = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    if contents.texture is None:
        look = f'rgba="{words(np.array([*PLAIN, 1.0]))}"'
        assets = []
    else:
        look = f'material="{name}"'
        assets = [
            f'    <texture name="{name}" type="2d" file="{VISUAL}.png"/>',
            f'    <material name="{name}" texture="{name}" specular="0.1" shininess="0.1"/>',
        ]
    # A shell: MuJoCo refuses to weigh what is seen where it is thin, and need not.
    assets.append(f'    <mesh name="{name}_{VISUAL}" file="{VISUAL}.obj" inertia="shell"/>')
    assets += [f'    <mesh name="{name}_{piece}" file="{piece}.obj"/>' for piece in contents.piece_names]
    geoms = [
        f'      <geom class="{name}_collision" name="{name}_{piece}" mesh="{name}_{piece}"/>'
        for piece in contents.piece_names
    ]
    return "\n".join(
        [
            f"<mujoco model={quoteattr(name)}>",
            f'  <compiler angle="radian" meshdir="{MESHES}" texturedir="{MESHES}"/>',
            "  <default>",
            f'    <default class="{name}_visual">',
            f'      <geom type="mesh" contype="0" conaffinity="0" group="2" mass="0" {look}/>',
            "    </default>",
            f'    <default class="{name}_collision">',
            f'      <geom type="mesh" group="3" priority="1" {_friction(contents)}/>',
            "    </default>",
            "  </default>",
            "  <asset>",
            *assets,
            "  </asset>",
            "  <worldbody>",
            f'    <body name="{name}">',
            f'      <freejoint name="{name}"/>',
            f'      <inertial pos="{words(contents.com)}" mass="{contents.mass!r}"'
            f' fullinertia="{words(tensor)}"/>',
            f'      <geom class="{name}_visual" name="{name}_{VISUAL}" mesh="{name}_{VISUAL}"/>',
            *geoms,
            "    </body>",
            "  </worldbody>",
            "</mujoco>",
            "",
        ]
    )


def _friction(contents: Contents) -> str:
    """Sliding [1], torsional [m] and rolling [m] friction, and as many directions as are given."""
    torsional, rolling = (contents.parameter(name) for name in _COARSE)
    directions = 6 if rolling else 4 if torsional else 3
    numbers = np.array([contents.friction, torsional or 0.0, rolling or 0.0])
    return f'condim="{directions}" friction="{words(numbers)}"'


def _scene(contents: Contents) -> str:
    lower, upper = contents.mesh.vertices.min(axis=0), contents.mesh.vertices.max(axis=0)
    size = float((upper - lower).max())
    # The object starts at its own coordinates: the floor is where it does not yet touch.
    height = float(lower[2]) - 0.2 * size
    middle = 0.5 * (lower + upper)
    return "\n".join(
        [
            f'<mujoco model="{contents.name}_scene">',
            f'  <include file="{contents.name}.xml"/>',
            f'  <statistic center="{words(middle)}" extent="{2 * size!r}"/>',
            "  <asset>",
            '    <texture name="floor" type="2d" builtin="checker" rgb1="0.93 0.94 0.95"'
            ' rgb2="0.86 0.88 0.9" width="256" height="256"/>',
            f'    <material name="floor" texture="floor" texuniform="true" texrepeat="{2 / size!r}'
            f' {2 / size!r}"/>',
            "  </asset>",
            "  <worldbody>",
            f'    <light pos="{words(middle + size * np.array([1.0, -2.0, 4.0]))}" dir="-0.2 0.4 -0.9"/>',
            f'    <geom name="floor" type="plane" size="0 0 {size!r}" pos="0 0 {height!r}"'
            ' material="floor"/>',
            "  </worldbody>",
            "</mujoco>",
            "",
        ]
    )
