import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from report import made_up
from vision.models import learned

import dano
from dano.report import (
    _stage,
    _video,
    CAMERAS,
    draw_object,
    film_plan,
    PLAN_VIDEO,
    render_side_by_side,
    render_start,
    render_trajectory,
    VideoOptions,
)
from dano.report._object import with_error
from dano.report._stage import draw_label, frame_times, poses_at, stage
from dano.scene_file import drop_scene, parse_scene
from dano.vision import Camera, LearnedField

av = pytest.importorskip("av")
Image = pytest.importorskip("PIL.Image")

SIZE = (96, 64)
Run = tuple[dano.Scene, dano.Trajectory]


@pytest.fixture(scope="module")
def run() -> Run:
    """A ball that rolls over a floor, by hand: 0.5 s in steps of 10 ms."""
    scene = dano.Scene.create(
        bodies=[
            dano.Body("ball", dano.Sphere(0.2), mass=1.0),
            dano.Body("floor", dano.HalfSpace(), fixed=True),
        ],
        contacts=[dano.Contact("ball", "floor")],
        timestep=0.01,
    )
    times = 0.01 * jnp.arange(51.0)
    position = jnp.zeros((51, 2, 3)).at[:, 0, 0].set(2 * times - 0.5).at[:, 0, 2].set(0.199)
    orientation = jnp.zeros((51, 2, 4)).at[:, :, 0].set(1.0)
    angle = 10 * times
    orientation = orientation.at[:, 0, 0].set(jnp.cos(angle / 2)).at[:, 0, 2].set(jnp.sin(angle / 2))
    velocity = jnp.zeros((51, 2, 3)).at[:, 0, 0].set(2.0)
    omega = jnp.zeros((51, 2, 3)).at[:, 0, 1].set(10.0)
    states = dano.State(position, orientation, velocity, omega)
    ones = jnp.ones(50)
    return scene, dano.Trajectory(times, states, 0 * ones, ones.astype(int), ones > 0, scene.names)


@pytest.fixture(scope="module")
def cube() -> dano.NeuralObject:
    rng = np.random.default_rng(0)
    values = np.zeros((12, 12, 12))
    values[3:9, 3:9, 3:9] = 40.0
    field = dano.GridField(values, (-0.11, -0.11, -0.11), 0.02)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 0.05 * normals / np.abs(normals).max(axis=1, keepdims=True)
    return dano.NeuralObject.from_samples(
        points=points,
        density=rng.uniform(1, 30, 200),
        normals=normals,
        mass=0.3,
        com=(0, 0, 0),
        inertia=np.diag([1e-3, 2e-3, 2.5e-3]),
        field=field,
    )


def test_a_film_shows_what_an_object_has_learned_to_look_like(cube, tmp_path):
    """From the object's file, through the scene, to the picture: black where the palette has orange."""
    field = LearnedField.from_model(learned(), 120.0)
    network = field.model.appearance.network
    field = eqx.tree_at(
        lambda f: f.model.appearance.network.biases[-1], field, jnp.full_like(network.biases[-1], -20)
    )
    made = dano.NeuralObject.from_field(field, n_samples=200, resolution=24, mass=1.0)
    made.save(tmp_path / "black.dano", look=field.arrays)
    cube.save(tmp_path / "cube.dano")
    assert LearnedField.of_object(tmp_path / "cube.dano") is None
    again = LearnedField.of_object(tmp_path / "black.dano")
    for a, b in zip(jax.tree.leaves(field), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3)

    text = drop_scene(tmp_path / "black.dano")
    loaded = parse_scene(text, tmp_path / "scene.toml", n_steps=30)
    run = dano.simulate(loaded.scene, loaded.state, n_steps=30)
    pictures = []
    for looks in (None, loaded.looks()):
        render_trajectory(
            loaded.scene,
            run,
            None,
            strip=tmp_path / "strip.png",
            looks=looks,
            options=VideoOptions(size=SIZE, contact_points=False),
        )
        pictures.append(np.asarray(Image.open(tmp_path / "strip.png")).astype(int))
    painted, black = pictures
    where = painted[..., 0] - painted[..., 2] > 60
    assert where.sum() > 100
    assert np.median(black[where]) < 5
    with pytest.raises(ValueError, match="nobody"):
        render_trajectory(loaded.scene, run, None, strip=tmp_path / "no.png", looks={"nobody": field})


def test_draft(run: Run, tmp_path):
    """Half the size, fewer frames, and no shadow that a film has."""
    path, strips = tmp_path / "run.mp4", []
    for draft in (True, False):
        options = VideoOptions(
            fps=30, size=SIZE, camera="fixed", contact_points=False, clock=False, draft=draft
        )
        strips.append(tmp_path / f"{draft}.png")
        render_trajectory(*run, path if draft else None, strip=strips[-1], options=options)
    with av.open(path) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (SIZE[0] // 2, SIZE[1] // 2)
        assert stream.average_rate == 15
        count = sum(1 for _ in container.decode(stream))
    assert count == len(frame_times(run[1], 15, 1.0))
    quick, whole = (np.asarray(Image.open(strip)).astype(float) for strip in strips)
    # The last moment, at rest: the floor beside the body is darker in its shadow only.
    assert np.percentile(quick[..., 0], 5) > np.percentile(whole[..., 0], 5)


def test_video_has_every_frame_and_moves(run: Run, tmp_path):
    path, strip, told = tmp_path / "run.mp4", tmp_path / "run.png", []
    render_trajectory(
        *run,
        path,
        strip=strip,
        options=VideoOptions(fps=20, size=SIZE, slow_motion=1.5, camera="fixed"),
        progress=lambda *x: told.append(x),
    )
    with av.open(path) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, stream.pix_fmt) == (*SIZE, "yuv420p")
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]
    assert len(frames) == 16  # 0.5 s · 1.5 · 20 Hz, and the first
    # The orange ball moves to the right of the picture and its contact arrow with it.
    columns = [
        np.mean(np.nonzero((f[..., 0] - f[..., 2]) > 60)[1]) for f in (frames[0], frames[7], frames[-1])
    ]
    assert columns[0] + 10 < columns[1] < columns[2] - 10
    assert told[-1] == ("drawing", 1.0)
    with Image.open(strip) as sheet:
        assert sheet.width >= 3 * SIZE[0] and sheet.height >= 2 * SIZE[1]
    assert sorted(tmp_path.iterdir()) == [path, strip]


def stopped(run: Run, steps: int) -> Run:
    """The run up to a step."""
    scene, whole = run
    states = jax.tree.map(lambda x: x[: steps + 1], whole.states)
    residuals, iterations, converged = (
        x[:steps] for x in (whole.residuals, whole.iterations, whole.converged)
    )
    times = whole.times[: steps + 1]
    return scene, dano.Trajectory(times, states, residuals, iterations, converged, whole.names)


@pytest.mark.parametrize(
    ("field", "column", "by", "is_new"),
    [
        ("position", 0, 1e-7, False),
        ("position", 0, 1e-3, True),
        ("orientation", 2, 1e-7, False),
        ("orientation", 2, 2e-3, True),
        ("camera", 0, 1e-7, False),
        ("camera", 0, 1e-3, True),
    ],
)
def test_frames_in_which_nothing_is_seen_to_move_are_drawn_once(run: Run, field, column, by, is_new):
    # A pixel spans some 2 cm at the ball; what moves by less than a fiftieth of that is not drawn again.
    take = _video.take_of(*run, stage(run[0]), 3, VideoOptions(size=SIZE, contact_points=False))
    still = take._replace(
        position=np.repeat(take.position[:1], 3, axis=0),
        orientation=np.repeat(take.orientation[:1], 3, axis=0),
    )
    places = np.tile([0.0, -2.0, 0.5], (3, 1))
    moved = places if field == "camera" else getattr(still, field)[:, 0]
    moved[1, column] += by
    moved[2, column] += by
    cameras = [Camera(place, place + [0, 2.0, -0.3], width=SIZE[0], height=SIZE[1]) for place in places]
    first = _video._first_alike(still, cameras)
    assert first.tolist() == ([0, 1, 1] if is_new else [0, 0, 0])
    pictures = _video._painter(still, cameras, True)
    assert (pictures(1) != pictures(0)).any() == is_new


def test_a_creep_too_slow_to_be_seen_from_frame_to_frame_is_seen_in_the_end(run: Run):
    take = _video.take_of(*run, stage(run[0]), 200, VideoOptions(size=SIZE, contact_points=False))
    position = np.repeat(take.position[:1], 200, axis=0)
    position[:, 0, 0] += 1e-5 * np.arange(200)
    take = take._replace(position=position, orientation=np.repeat(take.orientation[:1], 200, axis=0))
    camera = Camera((0, -2, 0.5), (0, 0, 0.2), width=SIZE[0], height=SIZE[1])
    first = _video._first_alike(take, [camera] * 200)
    pixel = camera.pixel_angle * np.linalg.norm(position[0, 0] - camera.position)
    assert 4 < len(set(first)) < 20
    assert np.abs(position[:, 0, 0] - position[first, 0, 0]).max() < 0.02 * pixel


def test_two_runs_are_side_by_side_and_the_shorter_one_stands_at_its_end(run: Run, tmp_path):
    path, strip = tmp_path / "both.mp4", tmp_path / "both.png"
    (scene, whole), (_, half) = run, stopped(run, 25)
    options = VideoOptions(fps=20, size=SIZE, clock=False, camera="fixed")
    render_side_by_side((scene, scene), (whole, half), path, strip=strip, options=options)
    with av.open(path) as container:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(frames) == 11  # as long as the longer one
    width = SIZE[0]
    assert frames[0].shape[:2] == (SIZE[1], 2 * width + 2)
    orange = [f[..., 0] - f[..., 2] > 60 for f in frames]
    left, right = (
        [np.mean(np.nonzero(ball[:, part])[1]) for ball in orange]
        for part in (slice(width), slice(width + 2, None))
    )
    # The same camera and clock: until the second run stops, the halves are the same.
    np.testing.assert_allclose(left[:6], right[:6], atol=0.3)
    np.testing.assert_allclose(right[5:], right[5], atol=0.3)
    assert left[-1] > left[5] + 20
    with Image.open(strip) as sheet:
        assert sheet.size == (4 * width + 3 * 2, 2 * SIZE[1] + 2)


def test_arrows_of_two_runs_have_one_scale(run: Run):
    """At rest one sphere weighs twice the other: its arrow is twice as long."""
    scene, _ = run
    runs = []
    for mass in (1.0, 2.0):
        body = dano.Body("ball", dano.Sphere(0.2), mass=mass)
        scene = dano.Scene.create([body, scene.bodies[1]], [dano.Contact("ball", "floor")], timestep=0.01)
        rest = dano.simulate(scene, scene.initial_state(ball=dict(position=(0, 0, 0.2))), 100)
        runs.append((scene, rest))
    options = VideoOptions(fps=20, size=SIZE)
    takes = [_video.take_of(scene, rest, stage(scene), 21, options) for scene, rest in runs]
    touched = [take.touched for take in _video._with_equal_arrows(takes) if take.touched is not None]
    small, large = (each.shares[-1, 0] for each in touched)
    assert large == pytest.approx(2 * small, rel=1e-3) and 0 < large < 2.5


def test_a_label_stays_in_its_corner():
    grey = np.full((120, 200, 3), 200, np.uint8)
    for text in ("drop", "a/very/long/path/that/does/not/fit/into/a/small/picture/drop"):
        rows, columns = np.nonzero((draw_label(grey, text) < 100).all(axis=2))
        assert 0 < len(rows) and rows.max() < 120 / 6
        assert columns.min() < 8 and columns.max() < 200 - 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenes": 1}, "scenes must be two, for left and right, got 1"),
        ({"trajectories": 3}, "trajectories must be two, for left and right, got 3"),
        ({"labels": ("one",)}, "labels must be two"),
        ({"labels": "ab"}, "labels must be a list of"),
        ({"looks": [None]}, "looks must be two"),
        ({"options": VideoOptions(size=(8000, 64))}, "options.size must be two even numbers from 16 to 4056"),
        ({"options": VideoOptions(colours={"cat": "#000000"})}, "body must be one of"),
        ({"path": None}, "path or strip"),
    ],
)
def test_bad_pairs_are_refused(run: Run, tmp_path, options, message):
    count = {"scenes": 2, "trajectories": 2} | options
    given = {"scenes": [run[0]] * count.pop("scenes"), "trajectories": [run[1]] * count.pop("trajectories")}
    with pytest.raises(ValueError, match=message):
        render_side_by_side(**{"path": tmp_path / "run.mp4"} | count | given)
    assert not list(tmp_path.iterdir())


def test_moving_bodies_fill_a_third_of_the_height_and_stay_in_view(run: Run):
    scene, trajectory = run
    drawn = stage(scene)
    n = len(trajectory.times)
    # Ten times as far: a camera that stands still would show specks.
    position = 10 * np.asarray(trajectory.states.position)
    orientation = np.asarray(trajectory.states.orientation)
    seen = _stage.seen_of(scene, drawn, position, orientation)
    moving = seen.moving
    fills, cameras = {}, []
    for how in CAMERAS:
        cameras = _stage.cameras_for(seen, 0.01, (640, 400), how)
        assert len(cameras) == n
        fills[how] = _stage._least_fill(cameras, moving)
        for camera, points in zip(cameras, moving, strict=True):
            x, y = camera.project(points)[:, :2].T
            assert 0 < x.min() and x.max() < 640 and 0 < y.min() and y.max() < 400
    assert fills["fixed"] < 0.2
    assert fills["follow"] == fills["auto"] >= 1 / 3
    # Calm: from frame to frame the camera shifts by less than what it follows.
    places = np.array([camera.position for camera in cameras])
    shifts, steps = (np.linalg.norm(np.diff(x, axis=0), axis=-1).max() for x in (places, position[:, :1]))
    assert shifts <= 1.5 * steps


def test_a_motion_shorter_than_a_frame_is_one_picture(run: Run, tmp_path):
    path, strip = tmp_path / "run.mp4", tmp_path / "run.png"
    options = VideoOptions(fps=1, size=SIZE, contact_points=False)
    render_trajectory(*run, path, strip=strip, options=options)
    with av.open(path) as container:
        assert len(list(container.decode(video=0))) == 1
    with Image.open(strip) as sheet:
        assert sheet.size == SIZE


def test_an_interrupted_video_leaves_what_was_there(run: Run, tmp_path):
    path = tmp_path / "run.mp4"
    path.write_bytes(b"old")

    def interrupt(_: str, share: float) -> None:
        if share > 0.3:
            raise KeyboardInterrupt

    options = VideoOptions(fps=10, size=SIZE, contact_points=False)
    with pytest.raises(KeyboardInterrupt):
        render_trajectory(*run, path, options=options, progress=interrupt)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("missing/run.mp4", {}, "existing directory"),
        ("run.avi", {}, "must end in .mp4"),
        ("run.mp4", {"slow_motion": 1e9}, "options.slow_motion must be at most"),
        ("run.mp4", {"colours": {"cat": "#000000"}}, "body must be one of"),
        (None, {}, "path or strip"),
    ],
)
def test_bad_videos_are_refused(run: Run, tmp_path, name, options, message):
    options = VideoOptions(size=SIZE, **options)
    with pytest.raises(ValueError, match=message):
        render_trajectory(*run, None if name is None else tmp_path / name, options=options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"size": (95, 64)}, "even"),
        ({"camera": Camera((0, -2, 0), width=95, height=64)}, "even"),
        ({"camera": "above"}, "camera must be one of auto, fixed, follow, got 'above'"),
        ({"fps": 0}, "fps must be finite and > 0"),
        ({"slow_motion": -1.0}, "slow_motion must be finite and > 0"),
    ],
)
def test_options_of_films_out_of_range(wrong, message):
    with pytest.raises(ValueError, match=message):
        VideoOptions(**wrong)


def test_a_colour_may_be_of_a_body_of_one_of_two_scenes(run: Run, tmp_path):
    """What is orange in both is blue where its name is the one with a colour."""
    (scene, whole), path = run, tmp_path / "both.png"
    other = dano.Scene.create(
        bodies=[dano.Body("other", dano.Sphere(0.2), mass=1.0), scene.bodies[1]],
        contacts=[dano.Contact("other", "floor")],
        timestep=0.01,
    )
    renamed = dataclasses.replace(whole, names=other.names)
    options = VideoOptions(
        fps=2, size=SIZE, clock=False, contact_points=False, camera="fixed", colours={"other": "#1040ff"}
    )
    render_side_by_side((scene, other), (whole, renamed), None, strip=path, options=options)
    sheet = np.asarray(Image.open(path)).astype(int)
    blue = sheet[..., 2] - sheet[..., 0] > 60
    assert blue[SIZE[1] + 2 :].sum() > 20 and blue[: SIZE[1]].sum() == 0


def test_ghosts_stand_where_goals_are(run: Run, tmp_path):
    """A second, paler orange ball to the right of where the first one ends."""
    scene, whole = run
    goal = dano.Goal("ball", position=(1.3, 0, 0.199))
    task = dano.Task(n_steps=50, actuators=[dano.Actuator("ball", limit=1.0)], goals=[goal])
    strip = tmp_path / "plan.png"
    camera = Camera((0.4, -4, 0.5), (0.4, 0, 0.2), width=192, height=96)
    options = dataclasses.replace(PLAN_VIDEO, fps=2, camera=camera)
    film_plan(scene, task, made_up.plan(task, whole), strip=strip, options=options)
    first = np.asarray(Image.open(strip)).astype(int)[:96, :192]
    warmth = first[..., 0] - first[..., 2]
    ball, ghost = (
        warmth[tuple(camera.project(np.array([[x, 0, 0.199]]))[0, 1::-1].astype(int))] for x in (-0.5, 1.3)
    )
    assert ball > 60 and 0.2 * ball < ghost < 0.7 * ball
    assert np.abs(warmth[:, :20]).max() < 30
    # Plans are filmed without clock and contacts unless they are asked for.
    assert (PLAN_VIDEO.clock, PLAN_VIDEO.contact_points, PLAN_VIDEO.camera) == (False, False, "fixed")


def test_frames_fall_between_steps(run):
    _, trajectory = run
    times = frame_times(trajectory, 30, 1.0)
    position, orientation = poses_at(trajectory, times)
    np.testing.assert_allclose(position[:, 0, 0], 2 * times - 0.5, atol=1e-12)
    expected = np.stack([np.cos(5 * times), 0 * times, np.sin(5 * times), 0 * times], axis=1)
    np.testing.assert_allclose(orientation[:, 0], expected, atol=1e-12)


def test_object_figure_is_a_picture(cube, tmp_path):
    path = tmp_path / "cube.png"
    draw_object(cube, path, title="cube")
    with Image.open(path) as picture:
        assert picture.size == (1496, 924)
        pixels = np.asarray(picture.convert("RGB"))
    assert 0.1 < np.mean((pixels < 250).any(axis=2)) < 0.9
    with pytest.raises(ValueError, match="must end in .png"):
        draw_object(cube, tmp_path / "cube.jpg")
    with pytest.raises(ValueError, match="existing directory"):
        draw_object(cube, tmp_path / "missing" / "cube.png")


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(0.42131, 0.0007, "0.42131 ± 0.00070"), (12.3456, 0.2, "12.35 ± 0.20"), (2.5, 0.0, "2.5")],
)
def test_numbers_have_as_many_digits_as_their_error_allows(value, error, text):
    assert with_error(value, error) == text


def test_a_scale_is_a_round_length_below():
    from dano.report._stage import length_text, round_below

    for x, below in ((0.37, 0.2), (0.5, 0.5), (9.9, 5.0), (1.0, 1.0), (0.0019, 0.001)):
        assert round_below(x) == pytest.approx(below)
    assert [length_text(x) for x in (2.0, 0.2, 0.05, 0.002)] == ["2 m", "20 cm", "5 cm", "2 mm"]


def test_the_bar_is_as_long_as_what_it_stands_for():
    from dano.report._stage import draw_clock

    camera = Camera((0, -2, 0), (0, 0, 0), width=640, height=400)
    grey = np.full((400, 640, 3), 200, np.uint8)
    drawn = draw_clock(grey, camera, 0.25, 2.0)
    # Dark runs in the rows of the bar.
    row = drawn[400 - 400 // 30 - 1]
    bar = np.flatnonzero((row < 100).all(axis=1) & (np.arange(640) > 320))
    ends = camera.project(np.array([[0, 0, 0], [0.2, 0, 0]]))[:, 0]
    assert len(bar) == pytest.approx(ends[1] - ends[0], abs=2)


def test_a_picture_of_the_start_shows_where_bodies_are(tmp_path):
    bodies = [
        dano.Body("left", dano.Sphere(0.1), mass=1.0),
        dano.Body("right", dano.Box((0.1, 0.1, 0.1)), mass=1.0),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [], timestep=0.01)
    state = scene.initial_state(left=dict(position=(-0.3, 0, 0.1)), right=dict(position=(0.3, 0, 0.1)))
    render_start(scene, state, tmp_path / "start.png", size=(160, 100))
    with Image.open(tmp_path / "start.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (100, 160, 3)
    # Orange and blue, as everywhere: the first colours of the palette.
    orange = np.argwhere(pixels[..., 0] > pixels[..., 2] + 40)
    blue = np.argwhere(pixels[..., 2] > pixels[..., 0] + 40)
    assert len(orange) > 100 and len(blue) > 100
    assert abs(orange[:, 1].mean() - blue[:, 1].mean()) > 30
    with pytest.raises(ValueError, match="png"):
        render_start(scene, state, tmp_path / "start.gif")


def test_a_run_films_and_shows_itself(tmp_path):
    ball = dano.Body("ball", dano.Sphere(0.05), mass=0.2, position=(0, 0, 0.5))
    run = dano.simulate(dano.Scene.create([ball], timestep=0.01), duration=0.2)
    run.film(tmp_path / "ball.mp4", fps=10, size=(64, 48))
    run.film(tmp_path / "ball.png", size=(64, 48))
    run.show(tmp_path / "ball.html")
    assert all((tmp_path / f"ball.{kind}").stat().st_size > 500 for kind in ("mp4", "png", "html"))
    with pytest.raises(ValueError, match="film must be given options of .*did you mean 'fps'"):
        run.film(tmp_path / "ball.mp4", fp=10)
