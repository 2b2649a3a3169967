"""Formulas of the documentation become MathML while MkDocs builds its pages (`hooks` in mkdocs.yml).

Pages write `$…$` and `$$…$$`, which code hosts and notebooks show as mathematics, too. `pymdownx.arithmatex`
finds them in the text. Browsers draw MathML by themselves, so that the site needs no script and no network.
They place indices by a table of their font, which many phones and Linux machines do not have. So a font goes
with the site: the characters of formulas from STIX Two Math (SIL Open Font License), which ziamath brings.
"""

import re
from html import unescape
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

from math_core import LatexError, LatexToMathML

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
"""What arithmatex makes of a formula (`generic: true`): TeX between brackets, in a div if it is displayed."""
LATEX = LatexToMathML(fancy_error=False)
FONT = "style/formulas.woff"
"""File of the site that style/dano.css names."""
CHARACTERS = (
    range(0x20, 0x100),  # Latin
    range(0x2C6, 0x2DE),  # accents
    range(0x391, 0x3F7),  # Greek
    range(0x2010, 0x2070),  # spaces, primes, invisible operators
    range(0x2102, 0x2140),  # letters
    range(0x2190, 0x21C0),  # arrows
    range(0x2200, 0x2310),  # operators, brackets
    range(0x1D434, 0x1D468),  # Latin italics, as which MathML draws single letters
    range(0x1D6A4, 0x1D71C),  # Greek italics
)


def mathml(formula: str, displayed: bool) -> str:
    """TeX as MathML; a ValueError shows what is wrong and where."""
    try:
        return LATEX.convert_with_local_state(formula, displaystyle=displayed)
    except LatexError as error:
        raise ValueError(f"formula {formula!r}, at character {error}") from None


def typeset(page: str) -> str:
    """The HTML of a page with its formulas as MathML."""

    def replace(match: re.Match[str]) -> str:
        displayed = match[1] == "div"
        element = mathml(unescape(match[2]).strip(), displayed)
        return f'<div class="formula">{element}</div>' if displayed else element

    return FORMULA.sub(replace, page)


def write_font(path: Path) -> None:
    """The characters of formulas, with larger brackets, roots and indices, as a font for browsers."""
    from fontTools import subset

    options = subset.Options(flavor="woff", layout_features=["ssty", "dtls"], name_IDs=["*"], hinting=False)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=[code for block in CHARACTERS for code in block])
    path.parent.mkdir(parents=True, exist_ok=True)
    source = distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")
    with subset.load_font(source, options) as font:
        subsetter.subset(font)
        subset.save_font(font, path, options)


def on_page_content(html: str, **_: Any) -> str:
    """What MkDocs calls for each page; an error ends the build with the page's name."""
    return typeset(html)


def on_post_build(config: Any, **_: Any) -> None:
    """What MkDocs calls when all pages are written."""
    write_font(Path(config["site_dir"]) / FONT)
