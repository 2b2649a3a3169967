"""Pixels of rollouts: derivatives against differences at a step that can be seen."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from vision.models import learned

import dano
from dano.identification import Motion
from dano.pixels import draw_frames, film, identify_in_film
from dano.pixels._identify import _with_table, SETTLED
from dano.report import draw_simulated, write_identification_report
from dano.vision import Camera, Film, GAMMA, LearnedField, Light, PosedCamera, SurfaceModel, TrackOptions

STEPS, EVERY = 12, 6


@pytest.fixture(scope="module")
def look():
    return LearnedField.from_model(learned(), 60.0)


@pytest.fixture(scope="module")
def scene():
    params = dano.ContactParams(sliding_friction=0.4, sliding_drag=0.0, spring=5e4, damper=1e5)
    law = dano.CentroidLaw(stiction_velocity=1e-4)
    bodies = [dano.Body("ball", dano.Sphere(0.3), mass=1.0), dano.Body("floor", dano.HalfSpace(), fixed=True)]
    return dano.Scene.create(bodies, [dano.Contact("ball", "floor", params, law)], timestep=0.02)


def test_the_table_of_a_film_is_the_highest_level_plane_below_the_body():
    tilted = (np.cos(0.2), np.sin(0.2), 0.0, 0.0)
    planes = {"floor": -0.5, "table": 0.1, "ceiling": 2.0}
    bodies = [dano.Body(name, dano.HalfSpace(offset=height), fixed=True) for name, height in planes.items()]
    bodies += [dano.Body("ramp", dano.HalfSpace((0, np.sin(0.4), np.cos(0.4)), 0.2), fixed=True)]
    bodies += [dano.Body("ball", dano.Sphere(0.05), mass=1.0)]
    scene = dano.Scene.create(bodies, contacts=(), timestep=0.01)
    motion = Motion.create(np.arange(2) / 30, "ball", position=np.array([[[0, 0, 0.2]], [[0.1, 0, 0.16]]]))
    assert _with_table(scene, motion, TrackOptions()).table == pytest.approx(0.1)
    assert _with_table(scene, motion, TrackOptions(table=0.3)).table == 0.3
    below = dataclasses.replace(motion, position=motion.position - [0, 0, 1.0])
    assert _with_table(scene, below, TrackOptions()).table is None
    # A plane stands where its body does: its normal turns with it.
    solid = dano.Body("slope", dano.HalfSpace((0, 0, 1), 0.3), fixed=True)
    plane = solid.half_space_at(jnp.array([0.0, 0.0, 0.5]), jnp.array(tilted))
    assert plane is not None
    normal, offset = plane
    np.testing.assert_allclose(normal, [0, -np.sin(0.4), np.cos(0.4)], atol=1e-6)
    assert offset == pytest.approx(0.3 + 0.5 * np.cos(0.4), abs=1e-6)


@pytest.fixture(scope="module")
def pictures(scene, look):
    """A function of friction, first speed and the lamp's direction; compiled once for each derivative."""
    state = scene.initial_state(ball={"position": (-0.2, 0, 0.3), "velocity": (2.0, 0, 0)})
    camera = Camera((0.1, -1.8, 0.7), (0.1, 0, 0.3), width=24, height=16)
    lamp = Light((0.3, -0.6, 0.8))

    def at(numbers):
        friction, speed, aside = numbers
        moved = scene.replace_contact("ball", "floor", sliding_friction=friction)
        begun = dataclasses.replace(state, velocity=state.velocity.at[0, 0].set(speed))
        place = jnp.asarray(lamp.place).at[0].set(aside.astype(jnp.float32))
        lit = eqx.tree_at(lambda light: light.place, lamp, place / jnp.linalg.norm(place))
        seen = film(
            moved, begun, STEPS, {"ball": look}, camera, (lit,), every=EVERY, background=(0.1, 0.2, 0.4)
        )
        return seen.colour.astype(jnp.float64)

    return at


POINT = jnp.array([0.4, 2.0, 0.3])


def test_a_picture_shows_the_body_where_it_is(pictures, scene, look):
    seen = pictures(POINT)
    assert seen.shape == (STEPS // EVERY + 1, 24 * 16, 3)
    blue = np.abs(np.asarray(seen) - [0.1, 0.2, 0.4]).max(axis=2) > 0.05
    middle = [(frame.reshape(16, 24).sum(axis=0) * np.arange(24)).sum() / frame.sum() for frame in blue]
    # Some 0.2 m a frame to the right, at 0.1 m a pixel.
    assert np.all(np.diff(middle) > 1)


def test_derivatives_of_pixels_are_differences_at_a_visible_step(pictures):
    forward = np.asarray(jax.jit(jax.jacfwd(pictures))(POINT))
    value = jax.jit(pictures)
    across = np.tile(np.arange(24) - 11.5, 16)
    apart, together = [], []
    for k, step in enumerate((0.05, 0.05, 0.05)):
        high, low = (np.asarray(value(POINT.at[k].add(s * step))) for s in (1, -1))
        difference = (high - low) / (2 * step)
        assert np.linalg.norm(difference) > 0.1
        apart.append(np.linalg.norm(forward[..., k] - difference) / np.linalg.norm(difference))
        # All pixels together, weighted by how far to the right they are, say where the light has gone.
        slope, change = (np.einsum("fpc,p->f", x, across)[-1] for x in (forward[..., k], difference))
        together.append(abs(slope / change - 1))
    # Where an edge passes a sample of a ray, a difference of that size is not a derivative.
    assert max(apart) < 0.35, apart
    assert max(together) < 0.2, together


@pytest.mark.slow
def test_an_open_shutter_blurs_along_the_way_and_loses_no_light(scene, look):
    state = scene.initial_state(ball={"position": (-0.2, 0, 0.3), "velocity": (2.0, 0, 0)})
    camera = Camera((0.1, -1.8, 0.7), (0.1, 0, 0.3), width=24, height=16)
    lamps = (Light((0.3, -0.6, 0.8)),)
    sharp, blurred = (
        film(scene, state, STEPS, {"ball": look}, camera, lamps, every=EVERY, shutter=shutter)
        for shutter in (0.0, 0.08)
    )
    columns, spread = np.arange(24), []
    for seen in (sharp, blurred):
        covered = np.asarray(seen.opacity[1], np.float64).reshape(16, 24).sum(axis=0)
        middle = (covered * columns).sum() / covered.sum()
        spread.append((covered.sum(), middle, (covered * (columns - middle) ** 2).sum() / covered.sum()))
    (area, middle, variance), (blurred_area, blurred_middle, blurred_variance) = spread
    assert blurred_area == pytest.approx(area, rel=0.02)
    assert blurred_middle == pytest.approx(middle, abs=0.1)
    # A way of w pixels, in five equal parts: the variance of their middles is w² (1 − 1/25)/12.
    speed = float(dano.simulate(scene, state, EVERY).states.velocity[-1, 0, 0])
    way = 0.08 * speed / (camera.pixel_angle * 1.9)
    assert blurred_variance - variance == pytest.approx(0.08 * way**2, rel=0.15)
    light, blurred_light = ((np.maximum(x.colour[1], 0) ** GAMMA).sum() for x in (sharp, blurred))
    assert blurred_light == pytest.approx(light, rel=0.05)


@pytest.mark.slow
def test_derivatives_inside_a_picture_are_differences(look):
    """Where nothing appears or disappears: pixels on the ball before it and after it moves."""
    box = look.model.box
    ball = np.linalg.norm(box.nodes, axis=1).reshape(box.shape) - 0.3
    hard = LearnedField.from_model(SurfaceModel.create(ball, box, look.model.appearance), 400.0)
    camera = Camera((0, -1.0, 0.5), (0, 0, 0), width=48, height=32)
    lamps = (Light((0.3, -0.6, 0.8)),)

    def at(aside):
        position = jnp.stack([aside, 0.0 * aside, 0.0 * aside])[None, None]
        colour, opacity = draw_frames([hard], position, jnp.array([[[1.0, 0, 0, 0]]]), camera, lamps)
        return colour[0].astype(jnp.float64), opacity[0]

    slope = jax.jit(jax.jacfwd(lambda x: at(x)[0]))
    step = 0.5 * 0.8 * camera.pixel_angle  # half a pixel
    (high, over), (low, under) = (jax.jit(at)(s * step) for s in (1.0, -1.0))
    difference = np.asarray(high - low) / (2 * step)
    inside = ndimage.minimum_filter(np.minimum(over, under).reshape(32, 48), 5).ravel() > 0.99
    assert inside.mean() > 0.1

    def apart(slopes):
        return np.linalg.norm((slopes - difference)[inside]) / np.linalg.norm(difference[inside])

    # The slope of an interpolated normal is right to the size of a cell over the radius, 8 %.
    assert apart(np.asarray(slope(0.0))) < 0.12
    # Over the step its jumps average out: a term that were missing would not.
    middles = step * (np.arange(9) - 4) / 4.5
    assert apart(np.mean([np.asarray(slope(x)) for x in middles], axis=0)) < 0.01


@pytest.mark.slow
def test_forward_is_reverse(pictures):
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(STEPS // EVERY + 1, 24 * 16, 3)))
    loss = lambda numbers: jnp.sum(weights * pictures(numbers))  # noqa: E731
    np.testing.assert_allclose(jax.jacfwd(loss)(POINT), jax.grad(loss)(POINT), rtol=2e-3, atol=1e-3)


@pytest.fixture(scope="module")
def watched(scene, look):
    """A film of the ball, sliding with a friction of 0.3, and the camera that took it."""
    true = scene.replace_contact("ball", "floor", sliding_friction=0.3)
    state = scene.initial_state(ball={"position": (-0.2, 0, 0.3), "velocity": (2.0, 0, 0)})
    pose = np.array([[1.0, 0, 0, 0.05], [0, 0, -1.0, -1.9], [0, 1.0, 0, 0.35]])
    camera = PosedCamera(pose, focal=64.0, width=56, height=40)
    back = (0.1, 0.2, 0.4)
    lamps = (Light((0.3, -0.6, 0.8)),)
    seen = film(true, state, 12, {"ball": look}, camera, lamps, every=3, background=back)
    images = np.asarray(seen.colour)
    images = np.rint(255 * np.clip(images, 0, 1)).astype(np.uint8).reshape(-1, 40, 56, 3)
    masks = list(np.asarray(seen.opacity, np.float32).reshape(-1, 40, 56))
    n = len(images)
    taken = Film(tuple(map(str, range(n))), np.asarray(seen.times), [*images], [*masks], [None] * n, 1, ())
    motion = Motion.from_trajectory(dano.simulate(true, state, 12), bodies=["ball"], every=3)
    return taken, camera, motion


def tracked(motion, deviation, noise: np.ndarray | float = 0.0):
    """Poses as tracking gives them, with this deviation of positions [m], and noise added to these."""
    return Motion.create(
        motion.times,
        "ball",
        position=motion.position[:, 0] + noise,
        orientation=motion.orientation[:, 0],
        covariance=np.tile(np.diag([deviation**2] * 3 + [0.05**2] * 3), (len(motion.times), 1, 1)),
        point="origin",
    )


def friction_in(scene, taken, look, camera, motion):
    """What poses and pixels say of the friction between ball and floor."""
    friction = dano.Parameter("mu", lambda s: s.contact("ball", "floor").sliding_friction, 0.05, 1.0)
    options = TrackOptions(masks="given", rays=1500)
    return identify_in_film(
        scene, taken, look, camera, motion, [friction], tracking=options, initial="velocities"
    )


@pytest.mark.slow
def test_friction_is_found_from_pixels(scene, look, watched, tmp_path):
    taken, camera, motion = watched
    random = np.random.default_rng(1)
    # Poses that are wrong by 5 % of the ball's radius tell friction badly; the pixels tell it well.
    noise = 0.015 * random.normal(size=(len(motion.times), 3)) * [1, 0, 0]
    rough = tracked(motion, 0.015, noise)
    found = friction_in(scene, taken, look, camera, rough)
    before, after = (float(fit.values["mu"]) for fit in (found.poses, found.fit))
    assert abs(after / 0.3 - 1) < 0.02
    assert abs(after - 0.3) < 0.5 * abs(before - 0.3)
    assert len(found.history) >= 3
    assert found.fit.standard_errors["mu"] >= found.poses.standard_errors["mu"]
    check_page(found, taken, look, camera, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("slid_with", [0.25, 0.36])
def test_pixels_pull_poses_back_that_are_all_wrong_in_one_direction(scene, look, watched, slid_with):
    """Poses of another slide: they agree with one another and with the physics, only not with the film."""
    taken, camera, motion = watched
    other = scene.replace_contact("ball", "floor", sliding_friction=slid_with)
    state = scene.initial_state(ball={"position": (-0.2, 0, 0.3), "velocity": (2.0, 0, 0)})
    told = Motion.from_trajectory(dano.simulate(other, state, 12), bodies=["ball"], every=3)
    away = np.linalg.norm(told.position[-1, 0] - motion.position[-1, 0])
    found = friction_in(scene, taken, look, camera, tracked(told, away))
    assert float(found.poses.values["mu"]) == pytest.approx(slid_with, rel=0.01)
    assert float(found.fit.values["mu"]) == pytest.approx(0.3, rel=0.03)
    assert found.fit.standard_errors["mu"] >= found.poses.standard_errors["mu"]
    # They had something to add: the first pass moved the value by more than ends a search.
    assert found.settled and found.moves[0] > SETTLED > found.moves[-1]


@pytest.mark.slow
def test_pixels_that_repeat_the_poses_end_the_search(scene, look, watched):
    """Poses that are right leave the pixels nothing to add: one value, one error, one pass."""
    taken, camera, motion = watched
    found = friction_in(scene, taken, look, camera, tracked(motion, 0.015))
    assert found.settled and len(found.history) == 2
    assert found.fit is found.poses
    assert abs(float(found.fit.values["mu"]) / 0.3 - 1) < 0.02
    # What the pixels of that pass said is there to be compared. They say less than the poses: with them the
    # error is larger, and a part of it is what they moved the value by.
    moved = abs(float(found.history[1]["mu"]) - float(found.history[0]["mu"]))
    assert abs(float(found.history[1]["mu"]) / 0.3 - 1) < 0.02
    (share,) = found.moves
    assert share < SETTLED
    assert moved / share > float(found.fit.standard_errors["mu"])


def check_page(found, taken, look, camera, folder):
    """What the page says of the film: both values, the film, and the simulation where the body is."""
    Image = pytest.importorskip("PIL.Image")
    simulated = draw_simulated(taken, found, look, camera)
    for seen, drawn in zip(taken.images, simulated, strict=True):
        # Drawn over the film, at a motion that is nearly right, in the light that was found.
        assert np.abs(drawn.astype(int) - seen).mean() < 4
    Image.fromarray(np.full((40, 56, 3), 9, np.uint8)).save(folder / "place.png")
    bare = draw_simulated(taken, found, look, camera, background=folder / "place.png")
    apart = [np.abs(drawn.astype(int) - 9).max(axis=2) > 30 for drawn in bare]
    for covered, mask in zip(apart, taken.masks, strict=True):
        assert np.mean(covered == (mask > 0.5)) > 0.95
    write_identification_report(folder / "fit.html", found, film=taken, simulated=simulated)
    page = (folder / "fit.html").read_text()
    assert page.count("<video") == 2 and "from poses" in page and "from pixels" in page
    for fit in (found.poses, found.fit):
        assert f"<td>{fit.values['mu']:.6g}</td><td>{fit.standard_errors['mu']:.3g}</td>" in page
    with pytest.raises(ValueError, match="film must be given for a fit of a film"):
        write_identification_report(folder / "none.html", found)
    with pytest.raises(ValueError, match="simulated must be as many as frames, 5, got 4"):
        write_identification_report(folder / "none.html", found, film=taken, simulated=simulated[:4])
    with pytest.raises(ValueError, match="this fit is of poses"):
        write_identification_report(folder / "none.html", found.fit, film=taken, simulated=simulated)
    assert not (folder / "none.html").exists()


def test_motions_that_do_not_belong_to_a_film_are_refused(scene, look, watched):
    taken, camera, motion = watched
    with pytest.raises(ValueError, match="point='origin'"):
        identify_in_film(scene, taken, look, camera, motion, [])
    short = dataclasses.replace(motion, point="origin").part(0, 3)
    with pytest.raises(ValueError, match="for each of the film's 5 frames"):
        identify_in_film(scene, taken, look, camera, short, [])


def test_what_is_wrong_is_said(scene, look):
    state = scene.initial_state()
    camera = Camera((0, -2, 0.5))
    with pytest.raises(ValueError, match="got 'cube'"):
        film(scene, state, 2, {"cube": look}, camera, (Light((0, 0, 1)),))
    with pytest.raises(ValueError, match="lights must hold a Light"):
        film(scene, state, 2, {"ball": look}, camera, ())


def test_pixels_and_motion_meet_half_way_and_neither_makes_the_other_surer():
    from dano.pixels._identify import _disagreement, _fused

    times, turns = np.arange(3.0), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    width = np.diag([1e-3, 1e-3, 5e-3, 1e-2, 1e-2, 1e-2]) ** 2

    def motion(x: float, scale: float, known: slice) -> Motion:
        covariance, position = np.full((3, 6, 6), np.nan), np.full((3, 3), np.nan)
        covariance[known], position[known] = scale * width, [x, 0.0, 0.0]
        return Motion.create(
            times, "box", position=position, orientation=turns, covariance=covariance, point="origin"
        )

    told = motion(0.0, 1.0, slice(0, 3))
    same = _fused(motion(0.004, 1.0, slice(0, 2)), told, 1.0)
    assert same.covariance is not None
    assert same.position[:2, 0, 0] == pytest.approx(0.002, rel=1e-9)
    np.testing.assert_allclose(same.covariance[0, 0], width, rtol=1e-9)
    # The third frame is the motion's, which counts half.
    assert same.position[2, 0, 0] == 0.0
    np.testing.assert_allclose(same.covariance[2, 0], 2 * width, rtol=1e-9)
    # Those that are surer pull a pose to where they want it, and are half as sure.
    surer = _fused(motion(0.004, 1e-4, slice(0, 2)), told, 1.0)
    assert surer.covariance is not None
    assert surer.position[0, 0, 0] == pytest.approx(0.004, rel=2e-4)
    np.testing.assert_allclose(surer.covariance[0, 0], 2e-4 * width, rtol=1e-3)
    # But frames that disagree with the simulation by more than they say are as sure as that tells: 4 standard
    # deviations are the median of (4 / 2.31)² times fewer.
    apart = _disagreement(motion(0.004, 1.0, slice(0, 2)), told)
    assert apart == pytest.approx(16 / 5.348, rel=1e-3)
    assert _disagreement(motion(0.001, 1.0, slice(0, 2)), told) == 1.0
    as_sure = _fused(motion(0.004, 1e-4, slice(0, 2)), told, 1e4)
    assert as_sure.position[0, 0, 0] == pytest.approx(0.002, rel=1e-9)
    # Those that hardly know leave a pose where it is.
    vague = _fused(motion(0.004, 1e6, slice(0, 2)), told, 1.0)
    assert np.abs(vague.position[0, 0, 0]) < 1e-8
