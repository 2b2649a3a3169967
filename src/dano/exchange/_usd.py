"""Universal Scene Description with its physics schema and those of Newton and PhysX (Isaac Sim).

The schemas of the two programs need not be installed, here or where the file is opened: they are applied by
their names, beside those of USD itself.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from dano.exchange._triangles import Contents, PLAIN, SPLATS, SURROUNDINGS, Triangles, VISUAL
from dano.extras import optional
from dano.fields import Splats
from dano.maths import quat_from_matrix

NOTES = (
    "USD: friction and restitution are a physics material on what touches; how those of two bodies combine is"
    " the program's choice (PhysX: their mean; Newton: the solver's, and not all of them have restitution)."
    " Numbers of USD's own schema are float32; Newton's inertia is float64.",
    'USD: the variant set "collision" of the body says what touches: "convex" the pieces (where nothing else'
    ' is chosen), "newton_sdf" and "physx_sdf" a signed distance that Newton or Isaac makes of the surface,'
    " hollows included. Newton makes it on a GPU.",
)

_TILE = 8
"""Newton's grids of signed distances are a multiple of this along their longest axis."""


def check_usd() -> None:
    """Check that USD can be written.

    Raises:
        ImportError: If usd-core is missing.
    """
    optional("pxr", "USD needs usd-core", "usd")


def write_usd(folder: Path, contents: Contents) -> list[str]:
    """Write `NAME.usd`; names of the files."""
    from pxr import Usd, UsdGeom, UsdPhysics  # pyright: ignore[reportMissingImports]

    path = folder / f"{contents.name}.usd"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    body = UsdGeom.Xform.Define(stage, f"/{contents.name}").GetPrim()
    stage.SetDefaultPrim(body)
    UsdPhysics.RigidBodyAPI.Apply(body)
    _write_mass(body, contents)
    material = _write_material(stage, contents)
    _write_look(stage, contents)
    variants = body.GetVariantSets().AddVariantSet("collision")
    for variant, write in _COLLISIONS.items():
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            write(stage, contents, material)
    variants.SetVariantSelection(next(iter(_COLLISIONS)))
    if contents.splats is not None:
        _write_splats(stage, f"/{contents.name}/{SPLATS}", contents.splats)
    stage.GetRootLayer().Save()
    if contents.surroundings is None:
        return [path.name]
    around = Usd.Stage.CreateNew(str(folder / f"{SURROUNDINGS}.usd"))
    UsdGeom.SetStageUpAxis(around, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(around, 1.0)
    around.SetDefaultPrim(UsdGeom.Xform.Define(around, f"/{SURROUNDINGS}").GetPrim())
    _write_splats(around, f"/{SURROUNDINGS}/{SPLATS}", contents.surroundings)
    around.GetRootLayer().Save()
    return [path.name, f"{SURROUNDINGS}.usd"]


def _write_mass(body: Any, contents: Contents) -> None:
    from pxr import Gf, UsdPhysics  # pyright: ignore[reportMissingImports]

    inertia = contents.inertia
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    mass = UsdPhysics.MassAPI.Apply(body)
    mass.CreateMassAttr(contents.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, contents.com)))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, moments)))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, quat_from_matrix(axes))))
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    _apply(body, "NewtonMassAPI", {"newton:inertia": ("DoubleArray", inertia[rows, columns])}, varying=True)


def _write_material(stage: Any, contents: Contents) -> Any:
    from pxr import UsdPhysics, UsdShade  # pyright: ignore[reportMissingImports]

    material = UsdShade.Material.Define(stage, f"/{contents.name}/contact")
    prim = material.GetPrim()
    rubbing = UsdPhysics.MaterialAPI.Apply(prim)
    rubbing.CreateStaticFrictionAttr(contents.friction)
    rubbing.CreateDynamicFrictionAttr(contents.friction)
    rubbing.CreateRestitutionAttr(contents.parameter("restitution") or 0.0)
    names = {"newton:torsionalFriction": "torsional_friction", "newton:rollingFriction": "rolling_friction"}
    numbers = {name: ("Float", contents.parameter(own) or 0.0) for name, own in names.items()}
    _apply(prim, "NewtonMaterialAPI", numbers, varying=True)
    return material


def _write_look(stage: Any, contents: Contents) -> None:
    from pxr import Sdf, UsdGeom  # pyright: ignore[reportMissingImports]

    seen = _write_mesh(stage, f"/{contents.name}/{VISUAL}", contents.mesh)
    seen.CreateNormalsAttr(np.ascontiguousarray(contents.normals, np.float32))
    seen.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    plain = contents.texture is None
    colours = UsdGeom.PrimvarsAPI(seen).CreatePrimvar(
        "displayColor",
        Sdf.ValueTypeNames.Color3fArray,
        UsdGeom.Tokens.constant if plain else UsdGeom.Tokens.vertex,
    )
    colours.Set(_linear(np.array([PLAIN]) if plain else _vertex_colours(contents)))


def _write_splats(stage: Any, place: str, splats: Splats) -> None:
    """Gaussians in the schema that USD has for them."""
    from pxr import UsdVol, Vt  # pyright: ignore[reportMissingImports]

    seen = UsdVol.ParticleField3DGaussianSplat.Define(stage, place).GetPrim()
    deviations = np.exp(splats.scales)
    around = 3 * deviations.max(axis=1, keepdims=True)
    arrays = {
        "positions": splats.means,
        "scales": deviations,
        "opacities": splats.alphas,
        "radiance:sphericalHarmonicsCoefficients": splats.colours.reshape(-1, 3),
        "extent": np.stack([(splats.means - around).min(axis=0), (splats.means + around).max(axis=0)]),
    }
    for name, values in arrays.items():
        seen.GetAttribute(name).Set(np.ascontiguousarray(values, np.float32))
    # USD keeps quaternions real part last, as NumPy sees them.
    turns = np.ascontiguousarray(np.roll(splats.rotations, -1, axis=1), np.float32)
    seen.GetAttribute("orientations").Set(Vt.QuatfArrayFromBuffer(turns))
    seen.GetAttribute("radiance:sphericalHarmonicsDegree").Set(splats.degree)


def _write_pieces(stage: Any, contents: Contents, material: Any) -> None:
    """Convex pieces collide."""
    from pxr import UsdGeom  # pyright: ignore[reportMissingImports]

    if contents.splats is not None:
        # Drawn instead of it. Where it collides it stays, unseen.
        stage.OverridePrim(f"/{contents.name}/{VISUAL}").SetActive(False)
    for name, hull in zip(contents.piece_names, contents.pieces, strict=True):
        mesh = _write_mesh(stage, f"/{contents.name}/{name}", hull)
        UsdGeom.Imageable(mesh).CreatePurposeAttr(UsdGeom.Tokens.guide)
        _let_collide(mesh.GetPrim(), "convexHull", material)
        # Without it Newton takes fewer corners.
        _apply(mesh.GetPrim(), "NewtonMeshCollisionAPI", {"newton:maxHullVertices": ("Int", -1)})


def _write_newton_distance(stage: Any, contents: Contents, material: Any) -> None:
    """What is seen collides, in Newton by its signed distance."""
    surface = _surface(stage, contents)
    _let_collide(surface, "none", material)
    nodes = _TILE * math.ceil(contents.resolution / _TILE)
    _apply(surface, "NewtonCollisionAPI", {})
    _apply(surface, "NewtonSDFCollisionAPI", {"newton:sdfMaxResolution": ("Int", nodes)})
    stiffness = contents.parameter("stiffness")
    if stiffness is not None:
        # Its law is ours: pressure per depth.
        pressing = {
            "newton:hydroelasticEnabled": ("Bool", True),
            "newton:hydroelasticStiffness": ("Float", stiffness),
        }
        _apply(surface, "NewtonSDFCollisionAPI", pressing, varying=True)


def _write_physx_distance(stage: Any, contents: Contents, material: Any) -> None:
    """What is seen collides, in PhysX by its signed distance."""
    surface = _surface(stage, contents)
    _let_collide(surface, "sdf", material)
    _apply(surface, "PhysxCollisionAPI", {})
    resolution = {"physxSDFMeshCollision:sdfResolution": ("UInt", contents.resolution)}
    _apply(surface, "PhysxSDFMeshCollisionAPI", resolution)


def _surface(stage: Any, contents: Contents) -> Any:
    """The visible mesh, unseen where Gaussians are drawn instead."""
    from pxr import UsdGeom  # pyright: ignore[reportMissingImports]

    surface = stage.OverridePrim(f"/{contents.name}/{VISUAL}")
    if contents.splats is not None:
        UsdGeom.Imageable(surface).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    return surface


_COLLISIONS = {
    "convex": _write_pieces,
    "newton_sdf": _write_newton_distance,
    "physx_sdf": _write_physx_distance,
}
"""Variants of what collides; the first is chosen where a file says nothing else."""


def _let_collide(prim: Any, approximation: str, material: Any) -> None:
    from pxr import UsdPhysics, UsdShade  # pyright: ignore[reportMissingImports]

    UsdPhysics.CollisionAPI.Apply(prim)
    UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(approximation)
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def _apply(prim: Any, schema: str, attributes: dict[str, tuple[str, Any]], *, varying: bool = False) -> None:
    """Apply a schema of another program by its name.

    Args:
        prim: What to.
        schema: Its name.
        attributes: Type and value of each, by name.
        varying: Whether they may vary with time, by the schema.
    """
    from pxr import Sdf  # pyright: ignore[reportMissingImports]

    prim.AddAppliedSchema(schema)
    kind = Sdf.VariabilityVarying if varying else Sdf.VariabilityUniform
    for name, (type_name, value) in attributes.items():
        prim.CreateAttribute(name, getattr(Sdf.ValueTypeNames, type_name), False, kind).Set(value)


def _write_mesh(stage: Any, place: str, triangles: Triangles) -> Any:
    from pxr import UsdGeom  # pyright: ignore[reportMissingImports]

    mesh = UsdGeom.Mesh.Define(stage, place)
    points = np.ascontiguousarray(triangles.vertices, np.float32)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(np.full(len(triangles.faces), 3, np.int32))
    mesh.CreateFaceVertexIndicesAttr(np.ascontiguousarray(triangles.faces.ravel(), np.int32))
    mesh.CreateExtentAttr(np.stack([points.min(axis=0), points.max(axis=0)]))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return mesh


def _vertex_colours(contents: Contents) -> Float[np.ndarray, "v 3"]:
    """SRGB at the vertices, read off the picture where one of their faces has them."""
    assert contents.texture is not None
    image, faces = contents.texture.image, contents.mesh.faces
    size = len(image)
    found = np.zeros((len(contents.mesh.vertices), 3))
    u, v = np.moveaxis(contents.texture.corners, -1, 0)
    column, row = (u * size).astype(int), size - 1 - (v * size).astype(int)
    found[faces] = image[row, column] / 255
    return found


def _linear(srgb: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Linear light of sRGB in [0, 1]: what USD's colours are."""
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(light, np.float32)
