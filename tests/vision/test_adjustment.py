"""Corrections of cameras against cameras that are turned and shifted."""

import jax.numpy as jnp
import numpy as np
from vision.photographs import capture, CENTRE

from dano.vision import Rays
from dano.vision.training._adjustment import Adjustment

VIEWS = capture(12, 0).split("train")


def adjusted(correction: np.ndarray) -> Adjustment:
    made = Adjustment.create(VIEWS, CENTRE)
    return Adjustment(jnp.asarray(correction, jnp.float32), made.axes, made.angle, made.length, made.free)


def test_corrected_cameras_see_what_moved_rays_see():
    cameras = adjusted(np.random.default_rng(0).normal(size=(12, 6)))
    for i, view in enumerate(cameras.corrected(VIEWS)):
        stated = VIEWS[i].camera
        direction = jnp.asarray(stated.rays().reshape(-1, 3)[::97], jnp.float32)
        n = len(direction)
        origin = jnp.broadcast_to(jnp.asarray(stated.position, jnp.float32), (n, 3))
        zero = jnp.zeros(n, jnp.float32)
        moved = cameras.moved(Rays(origin, direction, zero, zero, origin), jnp.full(n, i, jnp.int32))
        # Turns are of some pixels, and exact to first order.
        np.testing.assert_allclose(
            moved.direction, view.camera.rays().reshape(-1, 3)[::97], atol=0.05 * stated.pixel_angle
        )
        np.testing.assert_allclose(moved.origin[0], view.camera.position, atol=1e-6)


def test_a_unit_is_a_pixel():
    for k, across in ((0, True), (1, True), (3, True), (4, True), (5, False)):
        cameras = adjusted(np.eye(6)[k] * np.where(np.arange(12) == 5, 1, 0)[:, None])
        # Of what one view alone does, little can be a motion of everything.
        before = VIEWS[5].camera.project(CENTRE[None])[0, :2]
        after = cameras.corrected(VIEWS)[5].camera.project(CENTRE[None])[0, :2]
        assert (0.6 < np.linalg.norm(after - before) < 1.2) == across


def test_motions_of_everything_are_no_corrections():
    turn, shift, growth = np.array([2e-3, -1e-3, 3e-3]), np.array([1e-3, 2e-3, -1e-3]), 4e-3
    rows = []
    for view in VIEWS:
        camera = view.camera
        away = camera.position - CENTRE
        moved = camera.axes @ (np.cross(turn, away) + shift + growth * away)
        length = camera.pixel_angle * np.linalg.norm(away)
        rows.append(np.concatenate([camera.axes @ turn / camera.pixel_angle, moved / length]))
    assert np.abs(rows).max() > 0.5
    np.testing.assert_allclose(adjusted(np.array(rows)).corrections, 0, atol=1e-5)


def test_held_out_views_get_what_all_cameras_have_in_common():
    correction = np.zeros((12, 6))
    correction[:, 0] = 0.7
    cameras = adjusted(correction)
    common = np.asarray(cameras.corrections)[:, 0].mean()
    held = capture(3, 0).split("train")[:1]
    before, after = (
        v.camera.project(CENTRE[None])[0, :2] for v in (held[0], cameras.corrected_lens(held)[0])
    )
    # A turn about the axis to the right moves pictures upwards or downwards only.
    assert abs(after[0] - before[0]) < 0.1
    assert abs(after[1] - before[1]) > 0.8 * abs(common) > 0.3
