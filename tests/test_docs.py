"""Every Python block of the README and of the guides runs as written, in a process of its own."""

import ast
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from mktestdocs import grab_code_blocks

from dano.names import Trouble, TROUBLES

REPOSITORY = Path(__file__).resolve().parents[1]
PROGRAMS = {
    str(page.relative_to(REPOSITORY)): program
    for page in [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    if (program := "\n".join(grab_code_blocks(page.read_text(encoding="utf-8"), lang="python")))
}
# Pages whose programs take a minute each to compile; what they show has tests of its own beside it.
LONG = tuple(f"docs/{page}.md" for page in ("arm", "identify", "joints", "learn", "robots", "track"))
# Packages that few have.
NEEDS = {
    "docs/arm.md": ("pybullet_data",),
    "docs/splats.md": ("mujoco_warp",),
    "docs/worlds.md": ("newton", "pxr"),
}
# Of the command line, the commands are what is public.
PACKAGES = [p for p in sorted((REPOSITORY / "src" / "dano").glob("*/__init__.py")) if p.parent.name != "cli"]
WIDEST = 90
"""Columns of a code block that fit the pages without scrolling, on a screen of 1280 pixels."""


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow if page in LONG else ()) for page in PROGRAMS]
)
def test_python_blocks_run(page: str, tmp_path: Path):
    for package in NEEDS.get(page, ()):
        pytest.importorskip(package, reason=f"{page} needs {package}")
    # One process a page, its blocks joined: a page may change JAX's configuration, as its reader would.
    command = [sys.executable, "-c", PROGRAMS[page]]
    # A page runs each program briefly, so code without LLVM's optimisations is done sooner.
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "src"), "XLA_FLAGS": flags}
    answer = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    if page == "README.md":
        # The README says what its program prints, and what a central difference gives.
        text = (REPOSITORY / page).read_text(encoding="utf-8").replace("−", "-")
        told = re.findall(r"It prints ([-.\d]+) and ([-.\d]+):", text)[0]
        difference = re.findall(r"difference of step 0\.01 gives ([-.\d]+)\.", text)[0]
        printed = answer.stdout.split()
        assert [float(number) for number in printed] == pytest.approx([float(t) for t in told], rel=5e-3)
        assert float(printed[1]) == pytest.approx(float(difference), rel=0.05)


def test_notebooks_say_what_their_pages_say():
    """Whose blocks run above; `python assets/write_notebooks.py` writes them."""
    folder = REPOSITORY / "docs" / "notebooks"
    writer = runpy.run_path(str(REPOSITORY / "assets" / "write_notebooks.py"))
    assert {file.stem for file in folder.iterdir()} == set(writer["GUIDES"])
    for page in writer["GUIDES"]:
        text = (folder / f"{page}.ipynb").read_text(encoding="utf-8")
        assert text == writer["notebook"](page)
        cells = json.loads(text)["cells"]
        code = "\n".join(cell["source"] for cell in cells if cell["cell_type"] == "code")
        assert ast.dump(ast.parse(code)) == ast.dump(ast.parse(PROGRAMS[f"docs/{page}.md"]))
        assert f"(notebooks/{page}.ipynb)" in (REPOSITORY / "docs" / f"{page}.md").read_text(encoding="utf-8")


def public(file: Path) -> set[str]:
    """The names that a package gives to its users."""
    body = ast.parse(file.read_text(encoding="utf-8")).body
    imports = [statement for statement in body if isinstance(statement, ast.ImportFrom)]
    return {alias.name for one in imports for alias in one.names if alias.asname == alias.name}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.parent.name)
def test_every_public_name_is_documented(package: Path):
    page = REPOSITORY / "docs" / "api" / f"{package.parent.name}.md"
    documented = set(re.findall(r"^ {8}- (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE))
    assert documented == public(package)


@pytest.mark.parametrize("page", [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))])
def test_no_code_block_scrolls_sideways(page: Path):
    inside, wide = False, []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if line.lstrip().startswith("```"):
            inside = not inside
        elif inside and len(line) > WIDEST:
            wide.append(f"{page.name}:{number} has {len(line)} columns")
    assert wide == []


def test_the_index_leads_to_every_page():
    docs = REPOSITORY / "docs"

    def linked(page: str) -> set[str]:
        return set(re.findall(r"\]\(([\w/]+\.md)", (docs / page).read_text(encoding="utf-8")))

    # Parts of the benchmarks are listed on their own first page.
    parts = {name for name in linked("benchmarks.md") if name.startswith("benchmarks/")}
    assert linked("index.md") | parts == {str(p.relative_to(docs)) for p in docs.rglob("*.md")} - {"index.md"}


def test_messages_name_headings_that_are_there():
    page = (REPOSITORY / TROUBLES).read_text(encoding="utf-8")
    headings = {heading.lower().replace(" ", "-") for heading in re.findall(r"^## (.+)$", page, re.MULTILINE)}
    assert set(get_args(Trouble)) <= headings


MENU = (REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8")
GUIDES = re.findall(r": (\w+\.md)$", MENU.split("- Start:\n")[1].split("\n  - Theory:")[0], re.MULTILINE)
WITHOUT_PICTURE = {"choose.md", "cli.md", "conventions.md", "troubles.md"}  # tables and lists
HEAVIEST = 300_000
"""Bytes of a picture."""


@pytest.mark.parametrize("page", sorted(set(GUIDES) - WITHOUT_PICTURE))
def test_a_guide_begins_with_a_picture(page: str):
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    first = text.split("\n\n")[1]
    assert re.fullmatch(r"!\[[^]]{20,}\]\(images/[\w/]+\.(webp|png)\)", first), first


@pytest.mark.parametrize("page", [*sorted((REPOSITORY / "docs").rglob("*.md"))], ids=lambda page: page.stem)
def test_pictures_are_there_and_light(page: Path):
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / name).stat().st_size <= HEAVIEST, name


def test_the_gallery_shows_every_example():
    shown = re.findall(r"\*\*`(\w+\.py)`\*\*", (REPOSITORY / "docs" / "gallery.md").read_text("utf-8"))
    assert shown == sorted(file.name for file in (REPOSITORY / "examples").glob("*.py"))


def imported_by_dano(package: str) -> set[str]:
    """The names of a package that `import dano` gives."""
    body = ast.parse((REPOSITORY / "src" / "dano" / "__init__.py").read_text(encoding="utf-8")).body
    imports = [one for one in body if isinstance(one, ast.ImportFrom) and one.module == f"dano.{package}"]
    return {alias.name for one in imports for alias in one.names}


@pytest.mark.parametrize(
    "page", sorted((REPOSITORY / "docs" / "api").glob("*.md")), ids=lambda page: page.stem
)
def test_a_page_of_the_api_begins_with_what_users_import(page: Path):
    names = re.findall(r"^ {8}- (\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    users = [name in imported_by_dano(page.stem) for name in names]
    constants = [re.fullmatch(r"[A-Z][A-Z_]{3,}", name) is not None for name in names]
    assert constants == sorted(constants), "constants are last"
    # Pages of packages that `import dano` takes nothing from have no order to keep.
    assert users == sorted(users, reverse=True), "names of `import dano` are first"


USERS_FIRST = (
    "contact",
    "engine",
    "exchange",
    "fields",
    "identification",
    "objects",
    "planning",
    "robots",
    "scene",
    "scene_file",
)
