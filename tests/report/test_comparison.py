"""The page of a comparison, from measurements that were made up."""

import math

import numpy as np
import pytest
from report.made_up import comparison

from dano.comparison import Row
from dano.report import verdict, write_comparison_report

pytest.importorskip("PIL")


def test_the_page_holds_rows_pictures_and_what_is_missing(tmp_path):
    write_comparison_report(tmp_path / "page.html", comparison(), title="A <box>")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<tr>") == 4
    assert page.count("<img") == 2
    assert "A &lt;box&gt;" in page and "CoACD &lt;is&gt; left out." in page
    assert "(b) hull of the surface as it is, φ = 3; MuJoCo: lies askew by 7.0°; floats" in page
    assert "points must span a volume" in page
    assert "nan" not in page.split("<table>")[1]


def test_verdicts():
    assert verdict(Row("", "", tilt=0.2, gap=-0.02)) == "sinks in"
    assert verdict(Row("", "", tilt=0.2, gap=0.0, volume_error=-0.5)) == "hollow or thin"
    assert verdict(Row("", "", tilt=0.2, gap=0.0, moving=0.1)) == "still moves"
    assert verdict(Row("", "", tilt=0.2, gap=0.0)) == "lies as it should"
    assert verdict(Row("", "", tilt=math.nan, note="refused")) == "refused"


def test_a_picture_shows_the_object_on_the_floor():
    from dano.report._comparison import draw_rest

    picture = draw_rest(comparison().scenery[0], 0.2)
    height, width, _ = picture.shape
    coloured = np.ptp(picture, axis=2) > 0.05
    # 20 × 10 cm in a picture that is 27 cm wide, its lower side on the line.
    assert coloured.sum() == pytest.approx(width**2 * 0.2 * 0.1 / 0.27**2, rel=0.05)
    assert np.flatnonzero(coloured.any(axis=1)).max() == pytest.approx(height * 0.88, abs=2)
