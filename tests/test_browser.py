"""Pages in a real browser: the documentation's pages open without errors in the console."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
BROWSER = os.environ.get("DANO_BROWSER") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def console_errors(page: Path, folder: Path) -> list[str]:
    """Lines that a page writes to the console with the level of errors."""
    assert BROWSER is not None
    command = [
        *(BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0"),
        *("--allow-file-access-from-files", f"--user-data-dir={folder}", "--virtual-time-budget=3000"),
        *("--dump-dom", page.as_uri()),
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "</html>" in answer.stdout
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
