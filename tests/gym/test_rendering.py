"""What environments show: pictures of where bodies are, a page that follows them."""

import urllib.request

import numpy as np
import pytest

import dano
from dano.gym import make_env, make_vector_env
from dano.vision import Camera

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'dano[gym]'")


@pytest.fixture(scope="module")
def sliding():
    """A puck that floats sideways."""
    puck = dano.Body("puck", dano.Sphere(0.1), mass=1.0)
    scene = dano.Scene.create([puck], timestep=0.1, gravity=(0, 0, 0))
    task = dano.Task(50, [dano.Actuator("puck", limit=1.0)], [dano.Goal("puck", position=(9, 0, 0))])
    return scene, scene.initial_state(puck=dict(velocity=(1, 0, 0))), task


def middle(picture):
    """Where the puck is [pixels]: what is far from grey."""
    y, x = np.nonzero(coloured(picture))
    return x.mean(), y.mean()


def area(picture):
    """Of the puck [pixels]."""
    return np.count_nonzero(coloured(picture))


def coloured(picture):
    return np.ptp(picture.astype(int), axis=2) > 40


def test_pictures_show_where_bodies_are(sliding):
    """By a camera that is given: the puck's centre is where the camera projects it."""
    scene, state, task = sliding
    camera = Camera((0.5, -4, 0), (0.5, 0, 0), width=160, height=100)
    env = make_env(scene, state, task, render_mode="rgb_array", camera=camera)
    env.reset(seed=0)
    for _ in range(6):
        env.step(np.zeros(3, np.float32))
        picture = env.render()
        assert picture.shape == (100, 160, 3) and picture.dtype == np.uint8
        expected = camera.project(np.asarray(env.unwrapped.state.position))[0, :2]
        np.testing.assert_allclose(middle(picture), expected, atol=1.5)
    assert env.metadata["render_fps"] == 10


def test_the_camera_keeps_what_moves_in_view(sliding):
    """In each episode, as large as at first; after a reset it is where it was."""
    scene, state, task = sliding
    many = make_vector_env(scene, state, task, 2, render_mode="rgb_array", size=(80, 60))
    many.reset(seed=0)
    first = many.render()
    assert len(first) == 2
    for _ in range(30):
        many.step(np.array([[0, 0, 0], [1, 0, 0]], np.float32))
    for picture in many.render():
        x, y = middle(picture)
        assert 3 < x < 77 and 3 < y < 57
        np.testing.assert_allclose(area(picture), area(first[0]), rtol=0.15)
    many.reset(seed=0)
    np.testing.assert_array_equal(many.render()[0], first[0])


def test_gymnasium_finds_nothing_wrong_with_it(sliding):
    from gymnasium.utils.env_checker import check_env

    scene, state, task = sliding
    env = make_env(scene, state, task, render_mode="rgb_array", size=(32, 32))
    with pytest.warns(UserWarning):
        check_env(env.unwrapped, skip_render_check=False)
    gymnasium.wrappers.RenderCollection(env).reset(seed=0)


def test_a_page_follows_the_steps(sliding, capsys):
    pytest.importorskip("viser", reason="pip install 'dano[view]'")
    scene, state, task = sliding
    env = make_env(scene, state, task, render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(3, np.float32))
    url = capsys.readouterr().out.split()[-1]
    with urllib.request.urlopen(url) as page:
        assert page.status == 200
    assert env.render() is None
    handle = env.unwrapped._rendering._page._drawn._handles[0][0]
    np.testing.assert_allclose(handle.position, (0.1, 0, 0), atol=1e-6)
    env.close()
    env.close()


def test_without_a_mode_nothing_is_drawn(sliding):
    env = make_env(*sliding)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None
