"""Mass properties against closed forms, and their error bars against the errors made."""

import jax
import numpy as np
import pytest

import dano

SHAPES = {
    "sphere": lambda: dano.Sphere(0.1),
    "box": lambda: dano.Box((0.1, 0.07, 0.05)),
    "rounded box": lambda: dano.Box((0.1, 0.07, 0.05), rounding=0.02),
    "cylinder": lambda: dano.Cylinder(0.05, 0.1),
    "capsule": lambda: dano.Capsule(0.05, 0.1),
    "ellipsoid": lambda: dano.Ellipsoid((0.1, 0.07, 0.05)),
    "posed box": lambda: dano.posed(
        dano.Box((0.1, 0.07, 0.05)), dano.Pose((0.3, -0.1, 0.2), (1.0, 0.4, 0.2, -0.3))
    ),
}


def closed_form(shape):
    """(volume, centroid, inertia about it) of a homogeneous solid of density one."""
    moments = shape.solid_moments()
    second = np.asarray(moments.second_moment)
    return float(moments.volume), np.asarray(moments.centroid), np.trace(second) * np.eye(3) - second


def check(properties, mass, com, inertia, size):
    """Within 0.5 % of the truth."""
    assert float(properties.mass) == pytest.approx(mass, rel=5e-3)
    np.testing.assert_allclose(properties.com, com, atol=5e-3 * size)
    np.testing.assert_allclose(properties.inertia, inertia, atol=5e-3 * np.abs(inertia).max())


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_against_closed_form(name):
    shape = SHAPES[name]()
    check(dano.MassProperties.from_field(shape), *closed_form(shape), 0.2)


def test_error_bars_are_honest():
    """Over 40 seeds and several shapes, 95 % of all figures or more lie within three standard errors."""
    within = []
    for name in ("sphere", "box", "cylinder", "capsule"):
        shape = SHAPES[name]()
        volume, com, inertia = closed_form(shape)
        for seed in range(40):
            found = dano.MassProperties.from_field(shape, resolution=32, key=jax.random.key(seed))
            errors = [(found.mass - volume, found.mass_error), (found.com - com, found.com_error)]
            errors.append((found.inertia - inertia, found.inertia_error))
            within += [np.abs(np.ravel(e)) <= 3 * np.ravel(s) for e, s in errors]
    assert np.concatenate(within).mean() >= 0.95


def test_mesh_against_its_own_moments():
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    mesh = trimesh.creation.capsule(height=0.2, radius=0.07, count=[24, 24])
    found = dano.MassProperties.from_field(dano.mesh_field(mesh))
    check(found, mesh.volume, mesh.center_mass, mesh.moment_inertia, 0.34)


def gaussian_grid(n=40, widths=(0.12, 0.09, 0.06), center=(0.03, -0.02, 0.01)):
    axis = np.linspace(-0.6, 0.6, n)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1) - np.asarray(center)
    values = 50 * np.exp(-0.5 * (x**2 / np.square(widths)).sum(-1))
    return dano.GridField(values, (-0.6,) * 3, axis[1] - axis[0])


def test_grid_is_exact():
    """A Gaussian: m = α φ₀ (2π)^{3/2} σxσyσz; inertia from variances plus a quarter cell of the spline."""
    grid = gaussian_grid()
    found = dano.MassProperties.from_field(grid, mass_scale=0.1)
    mass = 0.1 * 50 * (2 * np.pi) ** 1.5 * 0.12 * 0.09 * 0.06
    variances = np.square([0.12, 0.09, 0.06]) + float(grid.spacing[0]) ** 2 / 4
    assert float(found.mass) == pytest.approx(mass, rel=1e-4)
    np.testing.assert_allclose(found.com, [0.03, -0.02, 0.01], atol=1e-6)
    np.testing.assert_allclose(
        found.inertia, np.diag(mass * (variances.sum() - variances)), rtol=1e-3, atol=1e-8
    )
    assert float(found.mass_error) == 0.0


def test_sampled_integral_of_a_grid_agrees_with_the_exact_one():
    """The Monte Carlo rule on the same density, seen as an anonymous function, within its own error."""
    grid = gaussian_grid()
    low, high = np.asarray(grid.bounds)
    posed = dano.posed(grid, dano.Pose())
    exact, sampled = (
        dano.MassProperties.from_field(grid),
        dano.MassProperties.from_field(posed, resolution=32),
    )
    assert abs(float(sampled.mass - exact.mass)) < 4 * float(sampled.mass_error)
    assert np.all(np.abs(sampled.com - exact.com) < 4 * np.asarray(sampled.com_error) + 1e-12)
    assert np.all(np.abs(sampled.inertia - exact.inertia) < 4 * np.asarray(sampled.inertia_error) + 1e-12)
    assert np.all(high > low)


def test_given_mass_and_scale():
    sphere = dano.Sphere(0.1)
    by_scale = dano.MassProperties.from_field(sphere, mass_scale=700.0, resolution=32)
    by_mass = dano.MassProperties.from_field(sphere, mass=3.0, resolution=32)
    assert float(by_mass.mass) == pytest.approx(3.0, rel=1e-12)
    assert float(by_mass.mass_error) < 1e-9
    ratio = 3.0 / float(by_scale.mass)
    np.testing.assert_allclose(by_mass.inertia, ratio * np.asarray(by_scale.inertia), rtol=1e-9, atol=1e-15)
