"""Kinds of arguments, and for each the values that it must refuse."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

NAN, INF = float("nan"), float("inf")
Bad = Mapping[str, object]
"""Bad values by what is wrong with them."""


class Thing:
    """An object of no kind that dano knows."""

    def __repr__(self) -> str:
        return "<a thing>"


NOT_A_NUMBER: Bad = {"text": "1.0 m", "several": [1.0, 2.0], "nan": NAN, "thing": Thing(), "complex": 1 + 2j}
NUMBER: Bad = {**NOT_A_NUMBER, "infinite": INF, "nothing": None}
OPTIONAL_NUMBER: Bad = {**NOT_A_NUMBER, "infinite": INF}
NON_NEGATIVE: Bad = {**NUMBER, "negative": -1.0}
POSITIVE: Bad = {**NON_NEGATIVE, "zero": 0.0}
OPTIONAL_POSITIVE: Bad = {name: value for name, value in POSITIVE.items() if name != "nothing"}
OPTIONAL_NON_NEGATIVE: Bad = {name: value for name, value in NON_NEGATIVE.items() if name != "nothing"}
COUNT: Bad = {
    "share": 2.5,
    "text": "three",
    "nan": NAN,
    "zero": 0,
    "negative": -1,
    "several": [1, 2],
    "nothing": None,
}
OPTIONAL_COUNT: Bad = {name: value for name, value in COUNT.items() if name != "nothing"}
NAME: Bad = {"number": 3, "nothing": None, "list": ["a"], "thing": Thing()}
CHOICE: Bad = {"unknown": "nonsense", "number": 3, "thing": Thing()}
KEY: Bad = {"number": 0, "text": "key", "many": np.zeros((3, 2), np.uint32)}
LIST: Bad = {"number": 3, "wrong items": [3], "thing": Thing()}
FUNCTION: Bad = {"number": 3, "text": "f"}
SIZE: Bad = {
    "odd": (33, 32),
    "tiny": (2, 2),
    "one": (32,),
    "text": "big",
    "nan": (NAN, 32),
    "number": 32,
    "huge": (10**6, 10**6),
}
"""Of pictures."""
LOOKS: Bad = {"unknown": {"wall": None}, "number": 3, "no look": {"ball": 3}}
"""Of bodies, by name."""


def instance(*, optional: bool = False) -> Bad:
    """Values that are no instance of a class of dano's."""
    values: dict[str, object] = {"number": 3, "text": "text", "array": np.zeros(3), "thing": Thing()}
    return values if optional else {**values, "nothing": None}


def array(*shape: int, positive: bool = False, optional: bool = False) -> Bad:
    """Values that are no finite numbers of this shape."""
    good = np.ones(shape)
    holed, infinite = good.copy(), good.copy()
    holed.flat[0], infinite.flat[-1] = NAN, INF
    values: dict[str, object] = {
        "nan": holed,
        "infinite": infinite,
        "longer": np.ones((*shape[:-1], shape[-1] + 1)),
        "deeper": good[None],
        "number": 1.0,
        "empty": [],
        "text": "text",
        "texts": ["a"] * shape[0],
        "ragged": [[1.0], [1.0, 2.0], 3.0],
        "thing": Thing(),
    }
    if positive:
        values |= {"zero": 0 * good, "negative": -good}
    return values if optional else {**values, "nothing": None}


def source(folder: Path) -> Bad:
    """Files that cannot be read."""
    return {
        "missing": folder / "nowhere.npz",
        "folder": folder,
        "number": 3,
        "nothing": None,
        "thing": Thing(),
    }


def target(folder: Path, suffix: str) -> Bad:
    """Files that cannot be written."""
    taken = folder / f"taken{suffix}"
    taken.mkdir(exist_ok=True)
    return {"folder": taken, "no folder": folder / "nowhere" / f"a{suffix}", "number": 3, "thing": Thing()}


SHAPELESS: st.SearchStrategy[object] = st.one_of(
    st.none(),
    st.booleans(),
    st.text(max_size=8),
    st.binary(max_size=8),
    st.lists(st.floats(), max_size=5),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.sampled_from([NAN, INF, -INF, 1e308, -1e308, 5e-324, 0.0, -0.0, 1j]),
    st.integers(min_value=-(2**70), max_value=2**70),
)
"""Any value that somebody may hand over."""
