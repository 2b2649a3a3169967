"""Universal Scene Description with its physics schema, as Isaac Sim and Newton read it."""

from pathlib import Path

import numpy as np

from dano.exchange._contents import Contents, VISUAL
from dano.exchange._look import PLAIN
from dano.extras import optional
from dano.maths import quat_from_matrix

NOTES = (
    "USD: friction and restitution are a physics material on the pieces; how those of two bodies combine is"
    " the program's choice (PhysX: their mean). Masses are float32, as the schema has it.",
)


def check_usd() -> None:
    """Check that USD can be written.

    Raises:
        ImportError: If usd-core is missing.
    """
    optional("pxr", "USD needs usd-core", "usd")


def write_usd(folder: Path, contents: Contents) -> list[str]:
    """Write `NAME.usd`; names of the files."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade  # pyright: ignore[reportMissingImports]

    name = contents.name
    path = folder / f"{name}.usd"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    body = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(body.GetPrim())
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    moments, axes = np.linalg.eigh(contents.inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
    mass.CreateMassAttr(contents.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, contents.com)))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, moments)))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, quat_from_matrix(axes))))
    material = UsdShade.Material.Define(stage, f"/{name}/contact")
    rubbing = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    rubbing.CreateStaticFrictionAttr(contents.friction)
    rubbing.CreateDynamicFrictionAttr(contents.friction)
    rubbing.CreateRestitutionAttr(contents.parameter("restitution") or 0.0)

    def mesh_at(place: str, vertices: np.ndarray, faces: np.ndarray):
        mesh = UsdGeom.Mesh.Define(stage, place)
        points = np.ascontiguousarray(vertices, np.float32)
        mesh.CreatePointsAttr(points)
        mesh.CreateFaceVertexCountsAttr(np.full(len(faces), 3, np.int32))
        mesh.CreateFaceVertexIndicesAttr(np.ascontiguousarray(faces.ravel(), np.int32))
        mesh.CreateExtentAttr(np.stack([points.min(axis=0), points.max(axis=0)]))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        return mesh

    seen = mesh_at(f"/{name}/{VISUAL}", contents.mesh.vertices, contents.mesh.faces)
    seen.CreateNormalsAttr(np.ascontiguousarray(contents.normals, np.float32))
    seen.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    colours = UsdGeom.PrimvarsAPI(seen).CreatePrimvar(
        "displayColor", _colour_type(), UsdGeom.Tokens.constant if contents.texture is None else "vertex"
    )
    colours.Set(_linear(np.array([PLAIN]) if contents.texture is None else _vertex_colours(contents)))
    for piece, hull in zip(contents.piece_names, contents.pieces, strict=True):
        mesh = mesh_at(f"/{name}/{piece}", hull.vertices, hull.faces)
        UsdGeom.Imageable(mesh).CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr("convexHull")
        binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    stage.GetRootLayer().Save()
    return [path.name]


def _colour_type():
    from pxr import Sdf  # pyright: ignore[reportMissingImports]

    return Sdf.ValueTypeNames.Color3fArray


def _vertex_colours(contents: Contents) -> np.ndarray:
    """SRGB at the vertices, read off the picture where one of their faces has them."""
    assert contents.texture is not None
    image, faces = contents.texture.image, contents.mesh.faces
    size = len(image)
    found = np.zeros((len(contents.mesh.vertices), 3))
    u, v = np.moveaxis(contents.texture.corners, -1, 0)
    column, row = (u * size).astype(int), size - 1 - (v * size).astype(int)
    found[faces] = image[row, column] / 255
    return found


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB in [0, 1]: what USD's colours are."""
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(light, np.float32)
