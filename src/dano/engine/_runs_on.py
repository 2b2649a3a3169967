"""What makes the steps of a scene, in words."""

import jax

from dano.checks import checked_kind
from dano.engine.launching import scene_tables
from dano.native import kind_numbers, n_cores
from dano.scene import Scene


def runs_on(scene: Scene) -> str:
    """What the steps of a scene run on: device, precision, and what its kernels are built for.

    Args:
        scene: The scene.

    Raises:
        ValueError: If the scene has a law or a shape that kernels do not know.
    """
    checked_kind("scene", scene, Scene)
    built = dict(scene_tables(scene).features.values)
    parts = []
    if scene.contacts or scene.others is not None:
        own = f" with {built['LAW']}" if built.get("LAW") else ""
        laws = {"points" + own: len(scene.point_pairs) > 0, "patches": built["PATCHES"]}
        names = {number: name.lower().replace("_", " ") for name, number in kind_numbers().items()}
        solids = ", ".join(sorted(names[kind] for kind in built["KINDS"] if kind in names))
        parts.append(f"contact of {' and '.join(law for law, used in laws.items() if used)} on {solids}")
    if scene.joints:
        parts.append("joints and loops" if scene.loops else "joints")
    device = jax.default_backend()
    where = f"CPU ({n_cores()} cores; a rollout takes one)" if device == "cpu" else device.upper()
    return f"{where}, {scene.timestep.dtype.name}; kernels for {'; '.join(parts) or 'free bodies'}"
