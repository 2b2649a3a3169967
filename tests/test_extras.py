"""Optional packages."""

import json

import pytest

from dano.extras import is_installed, optional


def test_a_package_that_is_there_is_imported():
    assert is_installed("json") and optional("json", "this needs json", "view") is json


def test_a_missing_package_is_named_with_its_extra():
    assert not is_installed("no_such_package")
    with pytest.raises(ImportError, match=r"^textures need pillow: pip install 'dano\[export\]'$"):
        optional("no_such_package", "textures need pillow", "export")
