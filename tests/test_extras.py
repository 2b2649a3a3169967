"""Optional packages."""

import json

import pytest

from dano.extras import is_installed, optional, Package


def test_a_package_that_is_there_is_imported():
    assert is_installed("json") and optional("json", "this needs json", "view") is json


def test_a_missing_package_is_named_with_its_extra():
    assert not is_installed("no_such_package")
    with pytest.raises(ImportError, match=r"^textures need pillow: pip install 'dano\[export\]'$"):
        optional("no_such_package", "textures need pillow", "export")


def test_a_package_says_the_same_before_work_and_when_it_is_imported():
    there = Package("json", "this", "view")
    missing = Package("no_such_package", "films need a camera", "poses")
    there.check()
    assert there.load() is json
    for ask in (missing.check, missing.load):
        with pytest.raises(ImportError, match=r"^films need a camera: pip install 'dano\[poses\]'$"):
            ask()
