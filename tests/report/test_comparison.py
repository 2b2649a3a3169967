"""The page of a comparison, from measurements that were made up."""

import math

import numpy as np
import pytest

from dano.comparison import Comparison, Row, Scenery
from dano.exchange import convex_hull
from dano.report import verdict, write_comparison_report

pytest.importorskip("PIL")

BOX = convex_hull((np.array(list(np.ndindex(2, 2, 2))) - 0.5) * (0.2, 0.1, 0.1))


def made_up() -> Comparison:
    own = Row("neural object", "dano", preparation=2.0, tilt=0.1, gap=0.0, phantom=0.0, step_time=3e-4)
    surface = Row("hull of the surface as it is", "MuJoCo", 3.0, 0.5, 12, 1, 1, tilt=7.0, gap=0.04)
    failed = Row("hull of the cleaned surface", "MuJoCo", 99.0, note="points must span a volume")
    rows = [own, surface, failed]
    at = np.array([0.0, 0.0, 0.05])
    scenery = [Scenery(row, [BOX], BOX, np.eye(3), at) for row in rows[:2]]
    return Comparison(rows, scenery, "the neural object", 0.2, [3.0, 99.0], 50.0, 1, ["CoACD <is> left out."])


def test_the_page_holds_rows_pictures_and_what_is_missing(tmp_path):
    write_comparison_report(tmp_path / "page.html", made_up(), title="A <box>")
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

    picture = draw_rest(made_up().scenery[0], 0.2)
    height, width, _ = picture.shape
    coloured = np.ptp(picture, axis=2) > 0.05
    # 20 × 10 cm in a picture that is 27 cm wide, its lower side on the line.
    assert coloured.sum() == pytest.approx(width**2 * 0.2 * 0.1 / 0.27**2, rel=0.05)
    assert np.flatnonzero(coloured.any(axis=1)).max() == pytest.approx(height * 0.88, abs=2)
