"""What USD, Newton and PhysX read of an exported object; theirs are the names that their schemas have."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export.conftest import check_mass, QUICK, tensor

from dano.contact import ContactParams
from dano.exchange import export_object
from dano.maths import quat_to_matrix

pytest.importorskip("pxr", reason="USD needs usd-core")
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade  # pyright: ignore[reportMissingImports]

VARIANTS = ["convex", "newton_sdf", "physx_sdf"]


@pytest.fixture(scope="module")
def folder(thing, tmp_path_factory):
    place = tmp_path_factory.mktemp("stages") / "angle"
    contact = ContactParams(
        sliding_friction=0.35, restitution=0.25, torsional_friction=0.01, rolling_friction=0.002
    )
    export_object(thing, place, to="usd", contact=contact, **QUICK)
    return place


def opened(folder, variant: str | None = None) -> Any:
    """The stage, with a choice of what collides."""
    stage = Usd.Stage.Open(str(folder / "angle.usd"))
    if variant is not None:
        # The session's layer is this stage's alone.
        stage.SetEditTarget(stage.GetSessionLayer())
        stage.GetDefaultPrim().GetVariantSet("collision").SetVariantSelection(variant)
    return stage


def colliders(stage) -> dict[str, Any]:
    return {prim.GetName(): prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.CollisionAPI)}


def applied(prim) -> list[str]:
    """Names of applied schemas, also of those that are not installed."""
    found = prim.GetMetadata("apiSchemas")
    return [] if found is None else found.GetAppliedItems()


def newton_library() -> Any:
    return pytest.importorskip("newton", reason="what Newton reads needs newton")


def test_stage_holds_mass_in_metres_and_kilograms(thing, folder):
    stage = opened(folder)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1
    body = stage.GetDefaultPrim()
    assert body.HasAPI(UsdPhysics.RigidBodyAPI)
    mass = UsdPhysics.MassAPI(body)
    axes = mass.GetPrincipalAxesAttr().Get()
    matrix = quat_to_matrix(np.array([axes.GetReal(), *axes.GetImaginary()]))
    moments = np.array(mass.GetDiagonalInertiaAttr().Get())
    # Of single precision.
    check_mass(thing, mass.GetMassAttr().Get(), mass.GetCenterOfMassAttr().Get(), tensor(moments, matrix))
    assert "NewtonMassAPI" in applied(body)
    xx, yy, zz, xy, xz, yz = body.GetAttribute("newton:inertia").Get()
    np.testing.assert_array_equal([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], thing.mass.inertia)


def test_convex_pieces_collide_unless_something_else_is_chosen(folder):
    stage = opened(folder)
    choice = stage.GetDefaultPrim().GetVariantSet("collision")
    assert choice.GetVariantNames() == VARIANTS and choice.GetVariantSelection() == "convex"


@pytest.mark.parametrize(
    ("variant", "name", "approximation", "schema", "attribute", "value"),
    [
        ("convex", "collision_000", "convexHull", "NewtonMeshCollisionAPI", "newton:maxHullVertices", -1),
        # The next multiple of 8 of the 20 nodes of the mesh.
        ("newton_sdf", "visual", "none", "NewtonSDFCollisionAPI", "newton:sdfMaxResolution", 24),
        (
            "physx_sdf",
            "visual",
            "sdf",
            "PhysxSDFMeshCollisionAPI",
            "physxSDFMeshCollision:sdfResolution",
            20,
        ),
    ],
)
def test_what_collides_is_a_choice(folder, variant, name, approximation, schema, attribute, value):
    stage = opened(folder, variant)
    found = colliders(stage)
    assert list(found) == [name]
    prim = found[name]
    assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == approximation
    assert [each for each in applied(prim) if "SDF" in each or "NewtonMesh" in each] == [schema]
    assert prim.GetAttribute(attribute).Get() == value
    assert not any("hydroelastic" in each.GetName() for each in prim.GetAuthoredAttributes())


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_collides_has_the_friction(folder, variant):
    stage = opened(folder, variant)
    for prim in colliders(stage).values():
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        rubbing = UsdPhysics.MaterialAPI(material)
        assert rubbing.GetStaticFrictionAttr().Get() == pytest.approx(0.35)
        assert rubbing.GetDynamicFrictionAttr().Get() == pytest.approx(0.35)
        assert rubbing.GetRestitutionAttr().Get() == pytest.approx(0.25)
        assert "NewtonMaterialAPI" in applied(material)
        assert material.GetAttribute("newton:torsionalFriction").Get() == pytest.approx(0.01)
        assert material.GetAttribute("newton:rollingFriction").Get() == pytest.approx(0.002)


def test_stiffness_is_that_of_hydroelastic_contact(thing, tmp_path):
    written = export_object(
        thing, tmp_path / "angle", to="usd", contact=ContactParams(stiffness=2e6, hysteresis=0.1), **QUICK
    )
    stage = opened(tmp_path / "angle", "newton_sdf")
    surface = stage.GetPrimAtPath("/angle/visual")
    assert surface.GetAttribute("newton:hydroelasticEnabled").Get() is True
    assert surface.GetAttribute("newton:hydroelasticStiffness").Get() == 2e6
    assert any(note.startswith("No format has a place for hysteresis.") for note in written.notes)


@pytest.mark.parametrize("variant", VARIANTS)
def test_attributes_are_those_of_the_schemas_of_newton(folder, variant):
    schemas = pytest.importorskip("newton_usd_schemas", reason="the names of Newton need its schemas")
    defined = Sdf.Layer.FindOrOpen(str(Path(schemas.__file__).parent / "generatedSchema.usda"))
    seen, stage = 0, opened(folder, variant)
    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            name = attribute.GetName()
            if name.startswith("newton:"):
                specs = [defined.GetAttributeAtPath(f"/{schema}.{name}") for schema in applied(prim)]
                theirs = [spec for spec in specs if spec is not None]
                assert theirs, f"{name} is in no schema of {prim.GetPath()}"
                assert attribute.GetTypeName() == theirs[0].typeName
                assert attribute.GetVariability() == theirs[0].variability
                seen += 1
    # Inertia, two frictions, and one of what collides unless that is PhysX's.
    assert seen == (3 if variant == "physx_sdf" else 4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_newton_reads_what_we_wrote(thing, folder, variant):
    newton = newton_library()
    builder, stage = newton.ModelBuilder(), opened(folder, variant)
    # Pytest makes errors of its warnings.
    builder.add_usd(stage)
    assert builder.body_label == ["/angle"]
    inertia = np.array(builder.body_inertia[0]).reshape(3, 3)
    check_mass(thing, float(builder.body_mass[0]), np.array(builder.body_com[0]), inertia)
    touches = [bool(flags & newton.ShapeFlags.COLLIDE_SHAPES) for flags in builder.shape_flags]
    shape = touches.index(True)
    assert sum(touches) == 1
    assert builder.shape_material_mu[shape] == pytest.approx(0.35)
    assert builder.shape_material_restitution[shape] == pytest.approx(0.25)
    assert builder.shape_material_mu_torsional[shape] == pytest.approx(0.01)
    assert builder.shape_material_mu_rolling[shape] == pytest.approx(0.002)
    prim = colliders(stage).popitem()[1]
    corners = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get())
    solid = builder.shape_source[shape].vertices
    np.testing.assert_allclose(np.ptp(solid, axis=0), np.ptp(corners, axis=0), atol=1e-6)
    # Newton's hulls have 64 corners where nothing is said.
    assert len(solid) > 64 if variant == "convex" else len(solid) == len(corners)
    assert builder.shape_sdf_max_resolution[shape] == (24 if variant == "newton_sdf" else None)
    assert not builder.shape_flags[shape] & newton.ShapeFlags.HYDROELASTIC


@pytest.mark.filterwarnings("ignore:set_const_:DeprecationWarning")
def test_newton_drops_it_onto_a_floor(folder):
    newton = newton_library()
    pytest.importorskip("mujoco_warp")
    builder = newton.ModelBuilder()
    builder.add_usd(str(folder / "angle.usd"))
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    with warnings.catch_warnings():
        # Newton asks for one version of MuJoCo, others are said to be untested.
        warnings.simplefilter("ignore", newton.NewtonWarning)
        solver = newton.solvers.SolverMuJoCo(model)
    before, after, control = model.state(), model.state(), model.control()
    start = float(before.body_q.numpy()[0, 2])
    for _ in range(200):
        solver.step(before, after, control, None, 0.002)
        before, after = after, before
    pose = before.body_q.numpy()[0]
    # Its lowest place is at z = 0.01 m of its frame.
    assert start == pytest.approx(0.0) and pose[2] == pytest.approx(-0.01, abs=1e-3)
    np.testing.assert_allclose(pose[3:], (0, 0, 0, 1), atol=0.02)
