"""From photographs of an ellipsoid in closed form to its field."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vision.photographs import capture, CENTRE, SEMI_AXES

from dano import load_field, NeuralObject
from dano.fields import redistanced
from dano.vision import (
    Capture,
    hull_distance,
    LearnedField,
    NodeGrid,
    survey,
    train,
    Trained,
    TrainOptions,
    View,
)
from dano.vision.capture._hull import object_box, silhouettes
from dano.vision.training._train import HistoryEntry, reason_to_stop

VOLUME = 4 / 3 * np.pi * float(np.prod(SEMI_AXES))
QUICK = TrainOptions(resolution=32, iterations=150, batch=512, features=4, check_every=50, cavities=False)


@pytest.fixture(scope="module")
def photos() -> Capture:
    return capture()


@pytest.fixture(scope="module")
def trained(photos: Capture) -> Trained:
    return train(photos, QUICK)


def test_the_hull_is_the_solid_to_a_tenth_of_a_pixel(photos: Capture):
    views = photos.split("train")
    lower, upper = object_box(views)
    assert np.all(lower < CENTRE - SEMI_AXES) and np.all(upper > CENTRE + SEMI_AXES)
    assert np.all(upper - lower < 2.6 * SEMI_AXES)
    box = NodeGrid.around(lower - 0.004, upper + 0.004, 40)
    hull = hull_distance(views, box)
    share = np.clip(0.5 - hull / box.spacing, 0, 1)
    # A pixel is 4.3 mm wide there; a tenth of it all around is 3 % of the volume.
    assert 0.97 < share.sum() * box.spacing**3 / VOLUME < 1.03
    # Nothing that belongs to the solid is cut away.
    ball = np.random.default_rng(0).normal(size=(500, 3))
    on_surface = CENTRE + SEMI_AXES * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    seen, cover = silhouettes(CENTRE + 0.95 * (on_surface - CENTRE), views)
    assert np.all(seen == len(views)) and np.all(cover > 0.5)


def test_redistancing_restores_a_signed_distance():
    box = NodeGrid(np.full(3, -1.2), 0.1, (25, 25, 25))
    radius = np.linalg.norm(box.nodes, axis=1).reshape(box.shape)
    distance = redistanced(radius**3 - 0.8**3, box.spacing)
    near = np.abs(radius - 0.8) < 0.2
    np.testing.assert_allclose(distance[near], radius[near] - 0.8, atol=0.015)
    # Further away by the nearest point of the nearest node that is near.
    np.testing.assert_allclose(distance, radius - 0.8, atol=0.05)


def test_training_recovers_the_solid_and_its_look(trained: Trained):
    assert trained.scores["test"].psnr > 30
    assert trained.scores["test"].mask_iou > 0.97
    assert trained.unseen < 0.02 and trained.warnings == ()
    made = NeuralObject.from_field(trained.field, mass_model="solid", mass=0.2, resolution=40, n_samples=500)
    np.testing.assert_allclose(made.mass.com, CENTRE, atol=0.0005)
    squares = SEMI_AXES**2
    inertia = 0.2 / 5 * (squares.sum() - squares)
    np.testing.assert_allclose(np.diag(made.mass.inertia), inertia, rtol=0.05)
    share = np.asarray(trained.field.jet(jnp.asarray(trained.survey.box.nodes.T), 0))
    np.testing.assert_allclose(share.sum() * trained.survey.box.spacing**3, VOLUME, rtol=0.05)


def test_the_field_is_a_probability_with_right_derivatives(trained: Trained):
    field = trained.field
    x = jnp.asarray(CENTRE + SEMI_AXES * np.array([[1.0, 0, 0], [0, 0.98, 0], [0, 0, 1.03]])).T
    value, gradient = field.jet(x, 1)
    assert np.all((value > 0) & (value < 1))
    np.testing.assert_allclose(value, [field.density(p) for p in x.T], rtol=1e-10)
    np.testing.assert_allclose(field.jet(x, 0), value, rtol=1e-12)
    expected = jax.vmap(jax.grad(field.density), in_axes=1, out_axes=1)(x)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-6)
    assert float(field.density(jnp.asarray(CENTRE))) > 0.999
    assert float(field.density(jnp.asarray(CENTRE + 0.2))) == 0


def test_a_saved_field_draws_the_same_picture(trained: Trained, photos: Capture, tmp_path: Path):
    trained.field.save(tmp_path / "egg.npz")
    again = LearnedField.load(tmp_path / "egg.npz")
    view = photos.split("test")[0]
    a, b = (f.picture(view.camera, view.light) for f in (trained.field, again))
    np.testing.assert_allclose(a.opacity, b.opacity, atol=1e-6)
    np.testing.assert_allclose(a.colour, b.colour, atol=2e-3)
    before = np.linalg.norm(view.camera.position - CENTRE) - a.depth[16, 16]
    assert SEMI_AXES.min() - 0.001 < before < SEMI_AXES.max()
    with pytest.raises(ValueError, match="light must be given"):
        again.picture(view.camera)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "egg.npz").read_bytes()[:1000])
    with pytest.raises(ValueError, match="cut.npz"):
        LearnedField.load(tmp_path / "cut.npz")
    x = jnp.asarray(CENTRE + 0.02)
    assert float(load_field(tmp_path / "egg.npz").density(x)) == float(again.density(x))
    with pytest.raises(
        ValueError, match=r"unknown options \['interpolation'\] for a dano-learned-field file"
    ):
        load_field(tmp_path / "egg.npz", interpolation="linear")
    with pytest.raises(ValueError, match="has a box of its own"):
        load_field(tmp_path / "egg.npz", crop=((-1, -1, -1), (1, 1, 1)))


def test_an_interrupted_training_resumes_where_it_was(trained: Trained, photos: Capture, tmp_path: Path):
    file = tmp_path / "state.npz"

    def interrupt(description, share):
        if description.startswith("training") and share * QUICK.iterations >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(photos, QUICK, checkpoint=file, progress=interrupt)
    said = []
    again = train(
        photos, QUICK, checkpoint=file, resume=True, progress=lambda what, share: said.append((what, share))
    )
    # Numbers stand behind a comma: what is before it is one piece of work, whose time left can be told.
    assert {what.partition(",")[0] for what, _ in said if "rays/s" in what} == {"training"}
    # Same seed, same random numbers at each step: the same field as without the interruption.
    np.testing.assert_array_equal(again.field.model.distance, trained.field.model.distance)
    assert again.scores == trained.scores
    other = TrainOptions(**{**vars(QUICK), "batch": 256})
    with pytest.raises(ValueError, match="the same photographs and options"):
        train(photos, other, checkpoint=file, resume=True)


def test_numbers_that_are_not_finite_stop_training_at_the_last_good_state(photos: Capture):
    broken = TrainOptions(**{**vars(QUICK), "rate_network": 1e30, "iterations": 40, "check_every": 1})
    result = train(photos, broken)
    assert result.stopped == "diverged"
    assert any("not finite" in text for text in result.warnings)
    assert np.all(np.isfinite(result.field.model.distance))


def test_a_full_disk_does_not_end_training(photos: Capture, tmp_path: Path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dano.archive.write_archive", full)
    with pytest.warns(UserWarning, match="could not be written"):
        train(
            photos,
            TrainOptions(**{**vars(QUICK), "iterations": 2, "check_every": 1}),
            checkpoint=tmp_path / "s.npz",
        )


@pytest.mark.slow
def test_a_third_of_the_views_still_gives_the_solid(photos: Capture):
    few = train(photos.thinned(8), QUICK)
    assert few.scores["test"].psnr > 26
    centre, radii = few.survey.box.nodes - CENTRE, SEMI_AXES
    true = (np.sum((centre / radii) ** 2, axis=1) < 1).reshape(few.survey.box.shape)
    inside = np.asarray(few.field.jet(jnp.asarray(few.survey.box.nodes.T), 0)).reshape(true.shape) > 0.5
    assert np.sum(inside & true) / np.sum(inside | true) > 0.92


@pytest.mark.slow
def test_a_lens_that_is_off_centre_is_corrected_for_held_out_views_too(photos: Capture):
    def off(view: View) -> View:
        c = view.camera
        return view.replaced(camera=c.replaced(centre=c.centre + np.array([0.8, -0.6])))

    stated = Capture([off(view) for view in photos.views])
    result = train(stated, TrainOptions(**{**vars(QUICK), "cameras": True}))
    errors = []
    for true, corrected in zip(photos.split("test"), result.capture.split("test"), strict=True):
        # Where the middle of the solid is seen, whatever motion of everything training has agreed on.
        middle = np.asarray(result.field.solid.solid_bounds).mean(0)
        image = corrected.camera.project(middle[None])[0, :2]
        errors.append(np.linalg.norm(image - true.camera.project(CENTRE[None])[0, :2]))
    # A whole pixel as stated.
    assert np.mean(errors) < 0.5


@pytest.mark.slow
def test_resolution_of_the_photographs_follows_the_grid():
    coarse = train(capture(12, 2, 96), TrainOptions(**{**vars(QUICK), "iterations": 2, "check_every": 2}))
    assert {view.image.shape for view in coarse.capture.views} == {(48, 48, 3)}


@pytest.mark.slow
def test_what_photographs_cannot_tell_is_said():
    good = survey(capture(12, 0), 32)
    assert good.residual < 0.03 and good.warnings == ()
    wrong = survey(capture(12, 0, focal=1.3), 32)
    assert wrong.residual > 0.04 and "focal length" in wrong.warnings[0]
    one_sided = survey(capture(12, 0, lowest=0.6), 32)
    assert one_sided.gap > np.pi / 2 and "from one side" in one_sided.warnings[0]
    few = survey(capture(4, 0), 32)
    assert any("only 4 views" in text for text in few.warnings)


def test_bad_masks_are_refused(photos: Capture):
    def with_mask(mask) -> Capture:
        fields = {name: getattr(photos.views[0], name) for name in View.__dataclass_fields__}
        return Capture([View(**{**fields, "mask": mask}), *photos.views[1:]])

    with pytest.raises(ValueError, match="1 show nothing of the object: train_0"):
        survey(with_mask(np.zeros((32, 32), np.float32)), 32)
    with pytest.raises(ValueError, match="cover the whole image"):
        survey(with_mask(np.ones((32, 32), np.float32)), 32)
    with pytest.raises(ValueError, match="every view must have a mask"):
        survey(with_mask(None), 32)


def looks(psnr: list[float], iou: list[float], volume: list[float]) -> list[HistoryEntry]:
    """Looks at held-out views, the last of them after all steps."""
    n = len(psnr)
    rows = zip(psnr, iou, volume, strict=True)
    return [HistoryEntry(100 * (i + 1), 100 * n, 0.0, 0.0, 0.0, *row) for i, row in enumerate(rows)]


def test_training_stops_when_outlines_become_worse_or_nothing_changes():
    better, shrinking = [24.0, 25.0, 26.0, 27.0, 28.0], [5.0, 4.0, 3.0, 2.0, 1.0]
    eaten = [0.98, 0.982, 0.975, 0.974, 0.973]
    assert reason_to_stop(looks(better, eaten, shrinking), 0.002) == "geometry"
    # Silhouettes that do not fit together by 4 % cannot tell.
    assert reason_to_stop(looks(better, eaten, shrinking), 0.04) is None
    level = [0.98] * 5
    assert reason_to_stop(looks(better, level, shrinking), 0.002) is None
    assert reason_to_stop(looks([28.0] * 5, level, [1.0] * 5), 0.002) == "converged"
    # Too early: the surface is still being made sharp.
    early = [entry._replace(iterations=1000) for entry in looks(better, eaten, shrinking)]
    assert reason_to_stop(early, 0.002) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 4}, "resolution must lie"),
        ({"iterations": 0}, "iterations must lie"),
        ({"rate_distance": 0.0}, "rate_distance must be finite and > 0"),
        ({"rate_features": -0.1}, "rate_features must be finite and > 0"),
        ({"mask_weight": -1.0}, "mask_weight must be"),
        ({"seconds": 0.0}, "seconds must be finite and > 0"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TrainOptions(**options)
