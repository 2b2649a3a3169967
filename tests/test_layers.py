"""What import-linter does not say: a module whose name begins with _ is known to its own package only."""

import ast
import re
import subprocess
import sys
from collections.abc import Set
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
MODULES = sorted((SOURCE / "dano").rglob("*.py"))


def private_imports(package: str, program: str) -> list[str]:
    """Names with a leading _ that a module of `package` (such as "dano.vision.capture") takes from others."""
    found = []
    for statement in ast.walk(ast.parse(program)):
        if isinstance(statement, ast.ImportFrom):
            names = [f"{statement.module}.{alias.name}" for alias in statement.names]
        elif isinstance(statement, ast.Import):
            names = [alias.name for alias in statement.names]
        else:
            continue
        found += [name for name in names if not _may_know(package, name)]
    return found


def _may_know(package: str, name: str) -> bool:
    parts = name.split(".")
    private = [i for i, part in enumerate(parts) if part.startswith("_") and not part.startswith("__")]
    if parts[0] != "dano" or not private:
        return True
    owner = ".".join(parts[: private[0]])
    return f"{package}.".startswith(f"{owner}.")


@pytest.mark.parametrize(
    ("program", "private"),
    [
        ("from dano.fields import GridField", False),
        ("from dano import __version__", False),
        ("from dano.vision.capture._hull import Box", False),  # its own
        ("from dano.vision._shared import x", False),  # of a package around it
        ("from jax._src import core", False),  # for others to judge
        ("from dano.vision.radiance._models import see", True),
        ("from dano.vision.radiance import _models", True),
        ("import dano.fields._grid", True),
        ("def f():\n    from dano.fields._grid import GridField", True),
    ],
)
def test_a_private_import_is_found(program: str, private: bool):
    assert bool(private_imports("dano.vision.capture", program)) is private


def test_no_module_imports_what_is_private_to_another_package():
    found = {}
    for module in MODULES:
        package = ".".join(module.relative_to(SOURCE).parts[:-1])
        if names := private_imports(package, module.read_text(encoding="utf-8")):
            found[str(module.relative_to(SOURCE))] = names
    assert found == {}


def test_a_file_is_read_at_a_sitting():
    lengths = {str(m.relative_to(SOURCE)): len(m.read_text(encoding="utf-8").splitlines()) for m in MODULES}
    assert {name: length for name, length in lengths.items() if length > 700} == {}


def test_a_folder_shows_few_names():
    """What others may import from it; dano itself and its vision are what users import."""
    shown = {str(m.parent.relative_to(SOURCE)): _names_of(m) for m in MODULES if m.name == "__init__.py"}
    assert {name: count for name, count in shown.items() if count > 60} == {
        "dano": shown["dano"],
        "dano/vision": shown["dano/vision"],
    }


def _names_of(module: Path) -> int:
    """Names that a module imports from others."""
    body = ast.parse(module.read_text(encoding="utf-8")).body
    return sum(len(statement.names) for statement in body if isinstance(statement, ast.ImportFrom))


def test_the_map_of_contributing_leads_somewhere():
    text = (SOURCE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.split("## Where things are")[1].split("## Rules")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ") and "`" in line]
    assert len(rows) >= 9
    root = SOURCE / "dano"
    for row in rows:
        # What has no folder lies in the one named before, or in the first of the row.
        folder, room = root, None
        for place in re.findall(r"`([\w/]+(?:\.py|/))`", row):
            places = [each / place for each in (folder, room or root, root, SOURCE.parent)]
            path = next((each for each in places if each.exists()), None)
            assert path is not None, row
            folder = path if path.is_dir() else path.parent
            room = room or folder


def test_the_stages_of_a_step_name_modules():
    page = SOURCE.parent / "docs" / "theory" / "step.md"
    table = page.read_text(encoding="utf-8").split("| stage |")[1].split("\n\n")[0]
    for row in table.splitlines()[2:]:
        _, stage, _, formulas, loops, _ = row.split("|")
        for package, names in (("physics", formulas), ("engine/kernels", loops)):
            for name in re.findall(r"`(\w+)`", names):
                place = SOURCE / "dano" / package / name
                assert place.is_dir() or place.with_suffix(".py").is_file(), (stage, name)


def test_no_modules_import_each_other_in_a_circle():
    files = {_name_of(path): path for path in MODULES}
    waiting = {name: (_imported(path, files.keys()) & files.keys()) - {name} for name, path in files.items()}
    # Whoever imports none of those that are left is in no circle, and leaves.
    while free := [name for name, found in waiting.items() if not found & waiting.keys()]:
        for name in free:
            del waiting[name]
    assert not waiting, f"these import each other: {sorted(waiting)}"


def _name_of(path: Path) -> str:
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: Path, names: Set[str]) -> set[str]:
    """What a module imports, also within functions and by a string, which import-linter does not see.

    What is imported for types alone is not.
    `from package import module` needs the module, `from package import name` the package.
    """
    found, tree = set(), ast.parse(path.read_text(encoding="utf-8"))
    for_types = [
        x for x in ast.walk(tree) if isinstance(x, ast.If) and ast.unparse(x.test) == "TYPE_CHECKING"
    ]
    skipped = {id(node) for block in for_types for node in ast.walk(block)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            each = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {full if full in names else node.module for full in each}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr == "import_module" and node.args and isinstance(node.args[0], ast.Constant):
                found.add(str(node.args[0].value))
    return found


FIRST = """
import sys
from pathlib import Path
import dano

ball = dano.Body("ball", dano.Sphere(0.05), mass=1.0)
scene = dano.Scene.create([ball, dano.Body("floor", dano.HalfSpace(), fixed=True)])
state, root, seen = scene.initial_state(ball={"position": (0, 0, 0.2)}), Path(dano.__file__).parent, set()

def look(frame, event, _):
    file, name = Path(frame.f_code.co_filename), frame.f_code.co_name
    if event == "call" and file.is_relative_to(root) and name != "<module>":
        seen.add(file.relative_to(root))

sys.setprofile(look)
dano.simulate(scene, state, 5)
sys.setprofile(None)
print(len({file for file in seen if file.parts[0] != "physics" and "kernels" not in file.parts}))
"""


def test_a_first_simulation_goes_through_few_files():
    """Who follows a call reads these files, besides kernels and formulas."""
    ran = subprocess.run([sys.executable, "-c", FIRST], capture_output=True, text=True, check=True)
    # One of them only where no object is there for this processor, and one is made.
    assert int(ran.stdout.split()[-1]) <= 22
