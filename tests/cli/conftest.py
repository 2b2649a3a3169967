"""A small object, made once by `dano build`, and the command line as a function."""

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dano.cli import main
from dano.fields import GridField, save_field


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    code: int
    out: str
    err: str


def ellipsoid_values() -> np.ndarray:
    """Densities of an ellipsoid with semi-axes of 6, 5 and 4 cells that fall from 100 to 0 over two cells."""
    x = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (18, 16, 14)), indexing="ij"), axis=-1)
    radius = np.linalg.norm(x / np.array([6.0, 5.0, 4.0]), axis=-1)
    return 100 * np.clip(0.5 - 2.5 * (radius - 1), 0, 1)


@pytest.fixture(autouse=True)
def no_progress(monkeypatch):
    """Lines of progress come every ten seconds: on a slow machine between those that tests look at."""
    monkeypatch.setattr("dano.cli._console.QUIET", math.inf)


@pytest.fixture
def interruptible():
    """Interrupts raise, also where tests run in the background of a shell, which has them ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def field(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("fields") / "egg.npz"
    save_field(GridField(jnp.asarray(ellipsoid_values()), (-0.085, -0.075, -0.065), 0.01), path)
    return path


@pytest.fixture
def run(capsys) -> Callable[..., Answer]:
    def call(*arguments: object) -> Answer:
        code = 0
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return Answer(code, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def egg(field, tmp_path_factory) -> Path:
    """The object; tests copy it or name it, and never write to it."""
    path = tmp_path_factory.mktemp("objects") / "egg.dano"
    main(["build", str(field), "-o", str(path), "--samples", "800", "--resolution", "20", "--mass", "0.5"])
    return path


@pytest.fixture
def scene(egg, tmp_path) -> Path:
    """A scene file of the object on a floor; edit its text for other scenes."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.replace("EGG", str(egg)), encoding="utf-8")
    return path


SCENE = """
timestep = 0.002
n_steps = 400

[[bodies]]
name = "egg"
object = "EGG"
position = [0.0, 0.0, 0.06]
omega = [0.0, 0.0, 1.0]

[[bodies]]
name = "floor"
shape = "half_space"
fixed = true

[[contacts]]
a = "egg"
b = "floor"
sliding_friction = 0.4
"""
