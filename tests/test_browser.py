"""Pages in a real browser: the documentation's pages open without errors in the console."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dano
from dano.report import view, write_view
from dano.report._page import image, table, video, warnings, write_page

REPOSITORY = Path(__file__).resolve().parents[1]
BROWSER = os.environ.get("DANO_BROWSER") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def console_errors(page: Path | str, folder: Path, picture: Path | None = None) -> list[str]:
    """Lines that a page writes to the console with the level of errors; a picture of it if asked for."""
    assert BROWSER is not None
    shown = ["--dump-dom"] if picture is None else [f"--screenshot={picture}", "--window-size=600,400"]
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


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
def test_an_error_is_heard(tmp_path):
    page = tmp_path / "wrong.html"
    page.write_text("<html><body><script>missing.thing()</script></body></html>", encoding="utf-8")
    assert "missing is not defined" in " ".join(console_errors(page, tmp_path / "profile"))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
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


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
@pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra view")
def test_the_viewer_opens_on_what_moves(tmp_path):
    bodies = [
        dano.Body("ball", dano.Sphere(0.01), mass=0.01),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")])
    run = dano.simulate(scene, scene.initial_state(ball={"position": (3.0, 0.0, 0.02)}), 10)
    viewer = view(scene, run, port=8123, block=False)
    try:
        assert console_errors(viewer.url, tmp_path / "profile", tmp_path / "page.png") == []
    finally:
        viewer.stop()
    # A ball of 1 cm three metres from the origin: its orange is in the middle of the page.
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    orange = picture[..., 0] - picture[..., 2] > 25
    rows, columns = np.nonzero(orange[:, :380])
    assert orange.mean() > 0.01
    assert abs(np.median(columns) - 300) < 60 and abs(np.median(rows) - 200) < 90


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
@pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra view")
def test_the_page_in_one_file_opens_without_errors(tmp_path):
    bodies = [
        dano.Body("ball", dano.Sphere(0.05), mass=0.1),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    scene = dano.Scene.create(bodies, [dano.Contact("ball", "floor")])
    run = dano.simulate(scene, scene.initial_state(ball={"position": (0.0, 0.0, 0.2)}), 30)
    write_view(scene, run, tmp_path / "run.html")
    assert console_errors(tmp_path / "run.html", tmp_path / "profile", tmp_path / "page.png") == []
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    assert (picture[..., 0] - picture[..., 2] > 25).mean() > 0.005


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine; DANO_BROWSER names one")
def test_pages_of_reports_open_without_errors(tmp_path):
    rng = np.random.default_rng(0)
    parts = [
        table(["name", "value"], [["<mass>", "1 kg"]]),
        warnings(["a & b"]),
        image(rng.random((20, 30, 3)), 60),
        video((REPOSITORY / "tests" / "data" / "tiny.mp4").read_bytes(), 60),
    ]
    write_page(tmp_path / "report.html", "A report <of> parts", parts)
    assert console_errors(tmp_path / "report.html", tmp_path / "profile") == []
