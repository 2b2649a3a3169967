# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false
"""The centroid law at a patch: against the reference, limits, and numbers of the authors' implementation."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from kernels.launching import KERNELS
from reference_step.patches import Patch, patch_wrench

import dano
from dano.contact import CentroidLaw

law = KERNELS.patch_law
PARAMS = dano.ContactParams(
    spring=3e3,
    damper=4e3,
    sliding_friction=0.4,
    sliding_drag=0.05,
    torsional_friction=0.02,
    torsional_drag=0.003,
    rolling_friction=0.03,
    rolling_drag=0.004,
)
LAWS = [
    CentroidLaw(smoothing=12.0, regularizer=2e-3),
    CentroidLaw(smoothing=12.0, regularizer=2e-3, adhesive=True),
    CentroidLaw(stiction_velocity=1e-4),
    CentroidLaw(stiction_velocity=1e-4, adhesive=True),
]
TWISTS = np.array(
    [
        [0.1, -0.2, 0.3, 1.0, -2.0, 0.5],
        [0.0, 0.0, -0.5, 0.0, 0.0, 0.0],
        [1e-5, 2e-5, 0.0, 0.0, 1e-6, 0.0],
        [3.0, 1.0, 2.0, 0.1, 0.1, 0.1],
    ]
)
NORMAL = np.array([0.36, 0.48, 0.8])


@wp.kernel(enable_backward=False)
def press(
    materials: wp.array(dtype=law.PatchMaterial),
    adhesive: wp.array(dtype=wp.int32),
    twists: wp.array2d(dtype=wp.float64),
    patch: KERNELS.overlap.Patch,
    wrenches: wp.array2d(dtype=law.PatchWrench),
    linear_wrenches: wp.array2d(dtype=law.PatchWrench),
    jacobians: wp.array2d(dtype=law.PatchJacobian),
):
    """Wrenches of each material at each twist: the law's, those of its linearisation, and the derivative."""
    i, j = wp.tid()  # pyright: ignore
    material = materials[i]
    pulls = adhesive[i] > 0
    velocity = wp.vec3d(twists[j, 0], twists[j, 1], twists[j, 2])
    spin = wp.vec3d(twists[j, 3], twists[j, 4], twists[j, 5])
    wrenches[i, j] = law.patch_law(material, patch, pulls, velocity, spin)
    motion = law.patch_motion(patch.normal, velocity, spin)
    duals = law.fitting_patch_duals(material, patch.overlap, pulls, motion)
    linear = law.linearized_patch(material, patch.overlap, pulls, motion, duals, wp.float64(1.0))
    linear_wrenches[i, j] = law.patch_wrench(material, patch.normal, motion, linear)
    jacobians[i, j] = law.patch_jacobian(material, patch.normal, motion, linear)


def pressed(laws, twists, params=PARAMS, overlap=0.02, normal=NORMAL):
    """Wrenches of laws at twists, those of their linearisations, and derivatives; (laws, twists, 6, ·)."""
    rows = np.ascontiguousarray([one.numbers(params) for one in laws])
    patch = KERNELS.overlap.Patch()
    patch.overlap, patch.normal = overlap, normal
    shape = (len(laws), len(twists))
    found = [
        wp.zeros(shape, dtype=kind, device="cpu")
        for kind in (law.PatchWrench, law.PatchWrench, law.PatchJacobian)
    ]
    given = [
        wp.array(ptr=rows.ctypes.data, dtype=law.PatchMaterial, shape=(len(laws),), device="cpu"),
        wp.array([one.adhesive for one in laws], dtype=wp.int32, device="cpu"),
        wp.array(np.asarray(twists, float), dtype=wp.float64, device="cpu"),
    ]
    wp.launch(press, shape, [*given, patch, *found], device="cpu")
    arrays: Any = [x.numpy() for x in found]
    wrenches, linear, slopes = arrays
    upper = np.concatenate([slopes["force"], np.zeros_like(slopes["force"])], axis=-1)
    whole = np.concatenate([upper, np.concatenate([slopes["moment"], slopes["turning"]], axis=-1)], axis=-2)
    return (*(np.concatenate([x["force"], x["moment"]], axis=-1) for x in (wrenches, linear)), whole)


def test_wrench_and_jacobian():
    """Smooth friction, friction that sticks, and contacts that pull, from rest to fast motion."""
    wrenches, linear, slopes = pressed(LAWS, TWISTS)
    for i, one in enumerate(LAWS):
        for j, twist in enumerate(TWISTS):
            contact: Any = SimpleNamespace(law=one, params=PARAMS)
            patch = Patch(0, 1, contact, 0.02, np.zeros(3), NORMAL, (np.zeros(3), np.zeros(3)))
            expected, slope = patch_wrench(patch, np.array([twist, np.zeros(6)]))
            np.testing.assert_allclose(wrenches[i, j], expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(linear[i, j], expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(slopes[i, j], slope, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("smoothing", "speed", "factor"),
    [
        (30, 0.01, 0.169),
        (30, 0.1, 0.787),
        (30, 1, 0.978),
        (8, 0.03, 0.145),
        (100, 0.003, 0.139),
        (10, 3, 0.978),
    ],
)
def test_friction_saturation(smoothing, speed, factor):
    """Share of Coulomb's friction reached at a sliding speed, tabulated for the reference implementation."""
    params = dano.ContactParams(spring=1.0, damper=0.0, sliding_friction=1.0, sliding_drag=0.0)
    twist = np.array([[speed, 0, 0, 0, 0, 0.0]])
    wrench = pressed([CentroidLaw(smoothing=smoothing)], twist, params, 1.0, np.array([0.0, 0.0, 1.0]))[0]
    assert -wrench[0, 0, 0] == pytest.approx(factor, abs=6e-4)


def test_contact_never_pulls_unless_adhesive():
    leaving = np.concatenate([2.0 * NORMAL, np.zeros(3)])[None]
    wrenches = pressed([CentroidLaw(), CentroidLaw(adhesive=True)], leaving)[0]
    assert not np.any(wrenches[0])
    assert wrenches[1, 0, :3] @ NORMAL < 0


def test_rest_has_a_finite_jacobian():
    wrenches, _, slopes = pressed([CentroidLaw()], np.zeros((1, 6)))
    np.testing.assert_allclose(wrenches[0, 0], np.concatenate([60.0 * NORMAL, np.zeros(3)]), atol=1e-12)
    assert np.all(np.isfinite(slopes))
