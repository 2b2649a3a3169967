"""What tests of films share: a learned object, and the camera that sees it."""

import pytest
from vision.drawn_films import above

from dano.scene_file import asset_look


@pytest.fixture(scope="module")
def bunny():
    return asset_look("trained_bunny")


@pytest.fixture(scope="module")
def camera():
    return above()
