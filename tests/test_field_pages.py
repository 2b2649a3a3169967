"""Pages of the API show what comments say of fields."""

import ast
import runpy
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
CLASS = '''
class Landing(NamedTuple):
    """Where it fell."""

    place: tuple[float, float]  # Of its centre, "μ" included [m]
    # How fast it was, and if that is not known NaN
    # [m/s].
    speed: float = eqx.field(
        default=0.0
    )
    _kept: int = 0  # Private
    bare: str = ""

    def fell(self):
        pass
'''


@pytest.fixture(scope="module")
def page():
    pytest.importorskip("griffe")
    return runpy.run_path(str(REPOSITORY / "assets" / "show_fields.py"))


def test_comments_beside_and_above_fields_are_read(page):
    (landing,) = ast.parse(CLASS).body
    assert page["field_comments"](landing, CLASS.splitlines()) == {
        "place": 'Of its centre, "μ" included [m]',
        "speed": "How fast it was, and if that is not known NaN [m/s].",
    }


def test_a_page_has_a_table_of_them(page, tmp_path):
    import griffe

    (tmp_path / "falling.py").write_text(CLASS, encoding="utf-8")
    landing = griffe.load(
        "falling",
        search_paths=[tmp_path],
        docstring_parser="google",
        extensions=griffe.load_extensions(page["ShowFields"]()),
    )["Landing"]
    text, table = landing.docstring.parsed
    assert text.value == "Where it fell."
    assert [(row.name, row.description) for row in table.value] == [
        ("place", 'Of its centre, "μ" included [m].'),
        ("speed", "How fast it was, and if that is not known NaN [m/s]."),
    ]
