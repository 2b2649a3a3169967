"""Formulas of the pages become mathematics: on the site, and on hosts of code, which read the same text."""

import re
import runpy
from pathlib import Path

import pytest
import yaml
from markdown import Markdown

from dano.extras import is_installed

REPOSITORY = Path(__file__).resolve().parents[1]
HOOK = runpy.run_path(str(REPOSITORY / "assets" / "typeset_formulas.py"))
SETTINGS = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))
CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)
DISPLAYED = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"\$([^$\n]+)\$")


def rendered(text: str) -> str:
    """A page as the site has it."""
    listed = [one if isinstance(one, dict) else {one: {}} for one in SETTINGS["markdown_extensions"]]
    configs = {name: config for one in listed for name, config in one.items()}
    html = Markdown(extensions=list(configs), extension_configs=configs).convert(text)
    return HOOK["typeset"](html)


def formulas(text: str) -> tuple[list[str], list[str]]:
    """Those of a page that stand by themselves, and those within sentences."""
    text = CODE.sub("", text)
    return DISPLAYED.findall(text), INLINE.findall(DISPLAYED.sub("", text))


PAGES = {
    str(page.relative_to(REPOSITORY / "docs")): text
    for page in sorted((REPOSITORY / "docs").rglob("*.md"))
    if "$" in CODE.sub("", text := page.read_text(encoding="utf-8"))
}


def test_theory_has_formulas():
    assert {"theory/contact.md", "theory/fields.md", "theory/integrator.md"} <= set(PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_each_formula_is_typeset(page: str):
    displayed, inline = formulas(PAGES[page])
    html = rendered(PAGES[page])
    assert html.count('<div class="formula"><math display="block">') == len(displayed)
    assert html.count("<math>") == len(inline)
    # What is left over was opened and not closed.
    assert "$" not in re.sub(r"<code.*?</code>", "", html, flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_formulas_are_the_same_on_hosts_of_code(page: str):
    displayed, inline = formulas(PAGES[page])
    for line in [*inline, *(line for formula in displayed for line in formula.split("\n"))]:
        # Markdown takes the backslash from \, and \{; they keep \\ at the end of a line only.
        assert re.findall(r"\\[^a-zA-Z]", re.sub(r" \\\\$", "", line)) == [], line
        # Typeset as letters of their own: v⁺ is v^+, x̂ is \hat x.
        written = re.sub(r"\\text{[^}]*}", "", line)
        assert re.findall(r"[²³¹⁰-ₜᵀᵢⱼ½\u0300-\u036f]", written) == [], line


@pytest.mark.parametrize("text", [r"$\frac{a}{b$", "$$\n\\sqroot{a}\n$$", r"$a_b_c$", r"$\left(a$"])
def test_a_broken_formula_is_an_error_that_shows_it(text: str):
    formula = text.strip("$\n")
    with pytest.raises(ValueError, match=re.escape(repr(formula))):
        rendered(f"Before\n\n{text}\n\nafter")


def test_an_inline_formula_and_a_displayed_one():
    html = rendered("So $a < b$ and\n\n$$\nx^2\n$$\n\nas in `$x$`.")
    assert "<p>So <math><mi>a</mi><mo>&lt;</mo><mi>b</mi></math> and</p>" in html
    block = '<math display="block"><msup><mi>x</mi><mn>2</mn></msup></math>'
    assert f'<div class="formula">{block}</div>' in html
    assert "<code>$x$</code>" in html


@pytest.mark.skipif(not (is_installed("ziamath") and is_installed("fontTools")), reason="extra docs")
def test_the_font_has_all_characters_of_the_formulas(tmp_path: Path):
    from fontTools.ttLib import TTFont

    HOOK["write_font"](tmp_path / "formulas.woff")
    assert (tmp_path / "formulas.woff").stat().st_size < 150_000
    with TTFont(tmp_path / "formulas.woff") as font:
        assert "MATH" in font  # where indices and bars of fractions are
        offered = font.getBestCmap()
    used = {c for text in PAGES.values() for one in formulas(text) for formula in one for c in formula}
    assert {c for c in used - {"\n"} if ord(c) not in offered} == set()
