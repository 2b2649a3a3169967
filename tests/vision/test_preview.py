import numpy as np
import pytest
from PIL import Image

from dano.vision.training._preview import checked_folder, write_preview


def test_photographs_stand_above_their_renderings(tmp_path):
    wanted, got = np.full((40, 30, 3), 0.2), np.full((40, 30, 3), 0.8)
    large = np.zeros((120, 50, 3)), np.ones((120, 50, 3))
    write_preview(tmp_path / "preview.png", [(wanted, got), large])
    with Image.open(tmp_path / "preview.png") as file:
        sheet = np.asarray(file)
    # The small pair is drawn three times as large, to 120 × 90 pixels.
    assert sheet.shape == (242, 142, 3)
    assert np.all(sheet[:120, :90] == 51) and np.all(sheet[122:, :90] == 204)
    assert np.all(sheet[:120, 92:] == 0) and np.all(sheet[122:, 92:] == 255)


def test_previews_go_to_a_folder(tmp_path):
    assert checked_folder(tmp_path / "new").is_dir()
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be a folder"):
        checked_folder(tmp_path / "file")
    with pytest.raises(ValueError, match="missing"):
        checked_folder(tmp_path / "no" / "new")
