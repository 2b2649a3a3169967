"""Pages in a real browser open without errors in the console, and show what they should."""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from report import made_up
from vision.models import learned
from vision.photographs import capture

import dano
from dano.report import (
    mass_estimates,
    view,
    write_capture_view,
    write_comparison_report,
    write_field_view,
    write_film_report,
    write_identification_report,
    write_tracking_report,
    write_training_report,
    write_view,
)
from dano.report._page import image, table, video, warnings, write_page
from dano.vision import LearnedField, visual_hull

REPOSITORY = Path(__file__).resolve().parents[1]
BROWSER = os.environ.get("DANO_BROWSER") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def console_errors(
    page: Path | str, folder: Path, picture: Path | None = None, size: tuple[int, int] = (600, 400)
) -> list[str]:
    """Lines that a page writes to the console with the level of errors; a picture of it if asked for."""
    assert BROWSER is not None
    width, height = size
    shown = ["--dump-dom"]
    if picture is not None:
        shown = [f"--screenshot={picture}", f"--window-size={width},{height}"]
    command = [
        *(BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0"),
        *("--allow-file-access-from-files", f"--user-data-dir={folder}", "--virtual-time-budget=4000"),
        *(*shown, page if isinstance(page, str) else page.as_uri()),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert "</html>" in answer.stdout if picture is None else picture.exists()
    lines = [line for line in answer.stderr.splitlines() if "CONSOLE" in line]
    wrong = ("ERROR:CONSOLE", "Uncaught", "Failed to load", "net::ERR")
    return [line for line in lines if any(w in line for w in wrong)]


in_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
with_viser = pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra view")

MEDIA = """<script>addEventListener("load", () => {
  const seen = [...document.images].map(i => [i.src, i.naturalWidth]);
  const films = [...document.querySelectorAll("video")].map(v => [v.src || v.currentSrc, v.videoWidth]);
  document.body.dataset.media = JSON.stringify(seen.concat(films));
});</script>"""
"""Writes the address and width of all that a page shows into the page."""


def shown_media(page: Path, folder: Path) -> dict[str, int]:
    """Widths of the pictures and films that a page has loaded, by their names; 0 for what has not come."""
    assert BROWSER is not None
    watched = page.with_name("watched.html")
    watched.write_text(
        page.read_text(encoding="utf-8").replace("</body>", f"{MEDIA}</body>"), encoding="utf-8"
    )
    command = [
        *(BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"),
        *(f"--user-data-dir={folder}", "--virtual-time-budget=4000", "--dump-dom", watched.as_uri()),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=240)
    found = re.search(r'data-media="([^"]*)"', answer.stdout)
    assert found is not None
    rows = json.loads(html.unescape(found[1]))
    names = [
        f"picture {i}" if address.startswith("data:") else address.rpartition("/")[2]
        for i, (address, _) in enumerate(rows)
    ]
    return dict(zip(names, (width for _, width in rows), strict=True))


@pytest.fixture(scope="module")
def fall() -> tuple[dano.Scene, dano.State, dano.Trajectory]:
    """A ball of 1 cm that falls, three metres from the origin."""
    bodies = [
        dano.Body("ball", dano.Sphere(0.01), mass=0.01),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")])
    start = scene.initial_state(ball={"position": (3.0, 0.0, 0.02)})
    return scene, start, dano.simulate(scene, start, 10)


def orange_pixels(picture: Path) -> np.ndarray:
    """Where a page shows the colour of the first body, or a field's."""
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    return pixels[..., 0] - pixels[..., 2] > 25


@in_browser
def test_an_error_is_heard(tmp_path):
    page = tmp_path / "wrong.html"
    page.write_text("<html><body><script>missing.thing()</script></body></html>", encoding="utf-8")
    assert "missing is not defined" in " ".join(console_errors(page, tmp_path / "profile"))


@in_browser
def test_a_picture_that_is_missing_is_seen(tmp_path):
    Image.new("RGB", (30, 20)).save(tmp_path / "there.png")
    page = tmp_path / "page.html"
    page.write_text("<html><body><img src='there.png'><img src='gone.png'></body></html>", encoding="utf-8")
    assert shown_media(page, tmp_path / "profile") == {"there.png": 30, "gone.png": 0}


@pytest.mark.slow
@in_browser
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="needs the extra docs")
def test_pages_of_the_documentation_open_without_errors(tmp_path):
    site = tmp_path / "site"
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(site)],
        cwd=REPOSITORY,
        check=True,
    )
    for name in ("index.html", "from/mujoco/index.html", "cli/index.html"):
        assert console_errors(site / name, tmp_path / "profile") == []
    # The film at the top, and the picture of every card below it.
    home = (REPOSITORY / "docs" / "index.md").read_text(encoding="utf-8")
    named = {Path(path).name for path in re.findall(r"!\[[^]]*\]\(images/([^)]+)\)", home)}
    assert len(named) >= 10
    loaded = shown_media(site / "index.html", tmp_path / "profile")
    assert named <= set(loaded)
    assert {name: width for name, width in loaded.items() if width < 20} == {}


@pytest.mark.slow
@in_browser
@with_viser
def test_the_viewer_opens_on_what_moves(fall, tmp_path):
    scene, _, run = fall
    viewer = view(scene, run, port=8123, block=False)
    try:
        assert console_errors(viewer.url, tmp_path / "profile", tmp_path / "page.png", (900, 500)) == []
    finally:
        viewer.stop()
    # Its orange is in the middle of the page, which the panel at the right does not reach.
    orange = orange_pixels(tmp_path / "page.png")
    rows, columns = np.nonzero(orange[:, :560])
    assert orange.mean() > 0.01
    assert abs(np.median(columns) - 450) < 60 and abs(np.median(rows) - 250) < 90


@pytest.mark.slow
@in_browser
@with_viser
def test_the_page_in_one_file_opens_without_errors(fall, tmp_path):
    scene, _, run = fall
    write_view(scene, run, tmp_path / "run.html")
    assert console_errors(tmp_path / "run.html", tmp_path / "profile", tmp_path / "page.png") == []
    assert orange_pixels(tmp_path / "page.png").mean() > 0.005


@pytest.mark.slow
@in_browser
@with_viser
@pytest.mark.skipif(find_spec("igl") is None, reason="needs the extra view")
@pytest.mark.parametrize("kind", ["density", "learned", "capture"])
def test_pages_of_fields_and_captures_open_on_all_of_them(kind, tmp_path):
    page = tmp_path / "page.html"
    if kind == "density":
        x = np.stack(np.meshgrid(*(np.arange(20) - 9.5,) * 3, indexing="ij"), axis=-1)
        ball = np.clip(7 - np.linalg.norm(x, axis=-1), 0, 1)
        write_field_view(dano.GridField(ball, (2.9, 0.0, 0.0), 0.01), page)
    elif kind == "learned":
        write_field_view(LearnedField.from_model(learned(), 120.0), page)
    else:
        write_capture_view(capture(n_train=8, n_test=1), page)
    assert console_errors(page, tmp_path / "profile", tmp_path / "page.png") == []
    pixels = np.asarray(Image.open(tmp_path / "page.png").convert("L"))[:, 60:540]
    # Darker than the paper and the message about WebGL on the left: all around the middle.
    rows, columns = np.nonzero(pixels[200:, 260:] < 235)
    assert len(rows) > 1000
    if kind == "density":
        orange = orange_pixels(tmp_path / "page.png")
        rows, columns = np.nonzero(orange[:, 250:])
        assert orange.mean() > 0.05
        assert abs(np.median(columns) + 250 - 330) < 80


@in_browser
def test_parts_of_reports_open_without_errors(tmp_path):
    rng = np.random.default_rng(0)
    parts = [
        table(["name", "value"], [["<mass>", "1 kg"]]),
        warnings(["a & b"]),
        image(rng.random((20, 30, 3)), 60),
        video((REPOSITORY / "tests" / "data" / "tiny.mp4").read_bytes(), 60),
    ]
    write_page(tmp_path / "report.html", "A report <of> parts", parts)
    assert console_errors(tmp_path / "report.html", tmp_path / "profile") == []


def _training(page: Path) -> None:
    photographs = capture(n_train=3, n_test=2, pixels=16)
    box, hull = visual_hull(photographs, 24)
    field = LearnedField.from_model(learned(), 120.0)
    made = dano.NeuralObject.from_field(field, n_samples=100, resolution=16, mass=1.0)
    found = made_up.trained(field, photographs, box, hull)
    grid = dano.bake(field, 16).grid
    write_training_report(page, found, photographs, made, mass_estimates(found, made, grid), title="A <mug>")


def _identification(page: Path, fall) -> None:
    scene, start, run = fall
    write_identification_report(
        page, made_up.fit(scene, start, dano.Motion.from_trajectory(run, bodies=["ball"]))
    )


def _film(page: Path, fall) -> None:
    scene, start, run = fall
    fit = made_up.fit(scene, start, dano.Motion.from_trajectory(run, bodies=["ball"]))
    frames = made_up.film()
    write_film_report(page, frames, made_up.film_fit(fit), frames.images, title="A <film>", notes=["made up"])


REPORTS = {
    "training": lambda page, _: _training(page),
    "identification": _identification,
    "tracking": lambda page, _: write_tracking_report(
        page, made_up.film(), made_up.tracked(), title="A <film>"
    ),
    "film": _film,
    "comparison": lambda page, _: write_comparison_report(page, made_up.comparison(), title="A <box>"),
}


@pytest.mark.slow
@in_browser
@pytest.mark.parametrize("kind", REPORTS)
def test_every_report_opens_with_all_its_pictures(kind, fall, tmp_path):
    page = tmp_path / "report.html"
    REPORTS[kind](page, fall)
    assert console_errors(page, tmp_path / "profile") == []
    media = shown_media(page, tmp_path / "profile")
    assert media and min(media.values()) > 20
