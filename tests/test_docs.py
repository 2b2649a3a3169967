"""Every Python block of the README and of the guides runs as written, with JAX as a user finds it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from mktestdocs import grab_code_blocks

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAMS = {
    str(page.relative_to(REPOSITORY)): program
    for page in [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    if (program := "\n".join(grab_code_blocks(page.read_text(encoding="utf-8"), lang="python")))
}


@pytest.mark.parametrize("page", PROGRAMS)
def test_python_blocks_run(page: str, tmp_path: Path):
    # One process a page, its blocks joined: a page may change JAX's configuration, as its reader would.
    command = [sys.executable, "-c", PROGRAMS[page]]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "src")}
    answer = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
