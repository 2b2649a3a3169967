"""Texts of the package and of its documentation use the terms of the field."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
# What texts do not say, and what they say instead: only what can be found without false hits.
WORDS = {
    r"(?<!ere )\b(is|are) none\b(?! of (these|them))": "is not a …",
    r"(?<!ere )\b(is|are) no (number|text|file|folder|path|grid|mesh|shape|state|geom|zip)s?\b": "is not a …",
    r"\bhangs? together\b": "connected, correlated, kinematic tree",
    r"\bdear(er|ly)? to\b|\bis dear(er)?\b": "expensive, slow",
    r"\bsieves?\b": "filter",
    r"\bless sure\b": "of larger standard deviation",
    r"\bleans? on (the (poses|frames)|those)\b": "is smoothed with",
    r"\bwakes? nobody\b": "does not wake sleeping bodies",
    r"\bwho (sticks|pushes|has only)\b": "which",
    r"\bis another one\b": "is a different …",
}
# Kernels and theory have texts of their own.
ELSEWHERE = ("src/dano/engine/kernels/", "src/dano/physics/", "docs/theory/")
TEXTS = [
    path
    for path in [
        REPOSITORY / "README.md",
        *(REPOSITORY / "docs").rglob("*.md"),
        *(REPOSITORY / "src").rglob("*.py"),
    ]
    if not str(path.relative_to(REPOSITORY)).startswith(ELSEWHERE)
]


@pytest.mark.parametrize("word", WORDS)
def test_texts_use_the_terms_of_the_field(word: str):
    found = [
        f"{path.relative_to(REPOSITORY)}:{number}: {line.strip()}"
        for path in TEXTS
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(word, line)
    ]
    assert found == [], f"say instead: {WORDS[word]}"


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("If it is none, such as 300.0.", 1),
        ("NaN where there is none.", 0),
        ("if size is None: it is dear to compile, and the cell is no number", 2),
        ("Parts that hang together.", 1),
    ],
)
def test_words_are_found_and_their_likes_are_not(text: str, count: int):
    assert sum(bool(re.search(word, text)) for word in WORDS) == count
