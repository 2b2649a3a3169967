"""Wavefront OBJ: what every program reads."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from dano.exchange._triangles import Texture, Triangles
from dano.extras import optional


def write_obj(
    path: Path,
    mesh: Triangles,
    *,
    normals: Float[np.ndarray, "v 3"] | None = None,
    texture: Texture | None = None,
    material: str | None = None,
) -> None:
    """Write a mesh.

    Args:
        path: The file.
        mesh: [m].
        normals: At the vertices, if it is to look smooth.
        texture: Whose coordinates the corners get.
        material: Of the file of materials beside it that has the same name.
    """
    lines = ["# metres, z up"]
    if material is not None:
        lines += [f"mtllib {path.with_suffix('.mtl').name}", f"usemtl {material}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices]
    corner = mesh.faces + 1
    words = corner.astype(str).astype(object)
    if texture is not None:
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in texture.corners.reshape(-1, 2)]
        words = words + "/" + (1 + np.arange(corner.size).reshape(corner.shape)).astype(str).astype(object)
    if normals is not None:
        lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in normals]
        words = words + ("/" if texture is not None else "//") + corner.astype(str).astype(object)
    lines += [f"f {a} {b} {c}" for a, b, c in words]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_material(path: Path, name: str, colour: tuple[float, float, float], image: str | None) -> None:
    """Write a file of one matte material, of a colour (sRGB) or a picture beside it."""
    plain = (1.0, 1.0, 1.0) if image is not None else colour
    words = " ".join(f"{x:.4g}" for x in plain)
    lines = [f"newmtl {name}", f"Ka {words}", f"Kd {words}", "Ks 0 0 0", "d 1", "illum 1"]
    lines += [] if image is None else [f"map_Kd {image}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_image(path: Path, texture: Texture) -> None:
    """Write the picture of a texture as a PNG.

    Raises:
        ImportError: If pillow is missing.
    """
    picture = optional("PIL.Image", "textures need pillow", "export")
    picture.fromarray(texture.image).save(path, "PNG", optimize=True)
