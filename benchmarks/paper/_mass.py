"""Integrated mass properties against closed forms, and whether the reported standard errors are honest."""

import importlib.util

import jax
import numpy as np

import dano
from benchmarks._measure import REPOSITORY, Row, skipped

N_SEEDS = 40
DENSITY = 1000.0  # [kg/m³]
GROUP = "Mass properties of a density field, default settings"


def mass_rows(*, quick: bool) -> list[Row]:
    """For each shape: the largest relative error over the seeds, and the share of honest error bars."""
    rows = []
    for name, shape in _shapes().items():
        rows += _shape_rows(name, shape, 3 if quick else N_SEEDS)
    if "mesh" not in _shapes():
        rows.append(skipped(GROUP, "mesh", "needs pip install 'dano[mesh]'"))
    return rows


def _shapes() -> dict[str, dano.AbstractShape]:
    shapes: dict[str, dano.AbstractShape] = {
        "sphere": dano.Sphere(0.1),
        "box": dano.Box((0.1, 0.07, 0.05)),
        "cylinder": dano.Cylinder(0.05, 0.1),
        "capsule": dano.Capsule(0.05, 0.1),
    }
    if all(importlib.util.find_spec(package) for package in ("trimesh", "igl")):
        from dano.fields import mesh_field

        shapes["mesh"] = mesh_field(REPOSITORY / "assets/bunny.obj", scale=0.2)
    return shapes


def _shape_rows(name: str, shape: dano.AbstractShape, n_seeds: int) -> list[Row]:
    truth, size = _closed_form(shape), float(shape.size)
    relative, honest = [], []
    for seed in range(n_seeds):
        found = dano.MassProperties.from_field(shape, mass_scale=DENSITY, key=jax.random.key(seed))
        value = _stacked(found.mass, found.com, found.inertia)
        spread = _stacked(found.mass_error, found.com_error, found.inertia_error)
        error = np.abs(value - truth)
        relative.append(
            [error[0] / truth[0], error[1:4].max() / size, error[4:].max() / np.abs(truth[4:]).max()]
        )
        honest.append(error <= 3 * spread)
    worst = 100 * np.max(relative, axis=0)
    share = 100 * np.mean(honest, axis=0)
    note = f"mass {worst[0]:.2g}, centre {worst[1]:.2g} of the size, inertia {worst[2]:.2g}"
    return [
        Row(GROUP, f"{name}: largest error, {n_seeds} seeds", float(worst.max()), "%", 0.5, note=note),
        Row(
            GROUP,
            f"{name}: within 3 standard errors",
            float(share.min()),
            "%",
            95.0,
            True,
            note=f"of the seeds, for the worst of ten quantities; {share.mean():.4g} % on average",
        ),
    ]


def _closed_form(shape: dano.AbstractShape) -> np.ndarray:
    moments = shape.solid_moments()
    assert moments is not None
    second = np.asarray(moments.second_moment)
    inertia = DENSITY * (np.trace(second) * np.eye(3) - second)
    return _stacked(DENSITY * moments.volume, moments.centroid, inertia)


def _stacked(mass, com, inertia) -> np.ndarray:
    """Mass, centre and the six entries of the inertia, shape (10,)."""
    return np.concatenate([[mass], com, np.asarray(inertia)[np.triu_indices(3)]])
