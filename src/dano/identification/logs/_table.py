"""Tables of text: what separates cells, where the names of columns stand, which cells are empty."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-", "--", "?")
"""What stands in cells, in small letters, where nothing was measured."""

_TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of trajectories of the TUM RGB-D benchmark, which have no header."""


class Table(NamedTuple):
    """Cells of a table as text.

    Attributes:
        source: The file, for messages.
        header: Names of the columns.
        rows: Cells of each row.
        lines: Number of the line in the file of each row.
    """

    source: Path
    header: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]

    def numbers(self, column: int) -> np.ndarray:
        """A column as numbers, NaN where cells are empty.

        Raises:
            ValueError: If a cell is not a number.
        """
        found = np.full(len(self.rows), np.nan)
        for i, row in enumerate(self.rows):
            cell = row[column].strip()
            if cell.lower() in _EMPTY:
                continue
            try:
                found[i] = float(cell)
            except ValueError as error:
                raise ValueError(
                    f"{self.source}: row {i + 1} (line {self.lines[i]}), column {self.header[column]!r}:"
                    f" {cell!r} is not a number"
                ) from error
        return found

    def stamps(self, column: int) -> tuple[np.ndarray, int]:
        """A column of whole numbers that floats would round, such as nanoseconds since 1970.

        Returns:
            Differences from the first, and the first; numbers with decimals are returned as they are, and 0.
        """
        cells = [row[column].strip() for row in self.rows]
        filled = [cell for cell in cells if cell.lower() not in _EMPTY]
        if not filled or not all(re.fullmatch(r"[+-]?\d{15,}", cell) for cell in filled):
            return self.numbers(column), 0
        first = int(filled[0])
        shifted = [np.nan if c.lower() in _EMPTY else float(int(c) - first) for c in cells]
        return np.array(shifted), first


def read_table(source: Path) -> Table:
    """Read a table of text.

    Cells are separated by commas, semicolons (then numbers may have decimal commas), tabs or blanks. The
    first line that is not a comment names the columns, or a comment with as many words does, as EuRoC has it.
    Eight columns of numbers without names are a trajectory of TUM: time, x, y, z, and a quaternion xyzw.

    Raises:
        ValueError: If the file is not text, has no header, or rows have different numbers of cells.
    """
    try:
        text = source.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{source} must be a text file, got one that is not") from error
    lines = [(i + 1, line) for i, line in enumerate(text.splitlines()) if line.strip()]
    comments = [line for _, line in lines if line.lstrip().startswith("#")]
    lines = [(i, line) for i, line in lines if not line.lstrip().startswith("#")]
    separator = _separator([line for _, line in lines[:20]])
    rows = [(i, _cells(line, separator)) for i, line in lines]
    header: Sequence[str] = rows[0][1] if rows else ()
    if rows and all(_is_number(cell) for cell in header):
        header = _told_by_comments(comments, len(header)) or (_TUM if len(header) == len(_TUM) else ())
        if not header:
            raise ValueError(
                f"{source} must begin with a line that names its columns, such as time, x, y, z, qw, qx, qy,"
                f" qz, got the numbers {', '.join(rows[0][1][:8])}"
            )
    else:
        rows = rows[1:]
    if not rows:
        raise ValueError(f"{source} must hold a header and at least one row, got {len(lines)} lines")
    header = tuple(word.strip().strip('"') for word in header)
    if len(set(header)) < len(header):
        raise ValueError(f"{source} must have different columns, got {list(header)}")
    for k, (i, row) in enumerate(rows):
        # A separator at the end of lines is common.
        if len(row) == len(header) + 1 and not row[-1].strip():
            row.pop()
        if len(row) != len(header):
            raise ValueError(
                f"{source}: row {k + 1} (line {i}) must hold {len(header)} cells, got {len(row)}"
            )
    return Table(source, header, [row for _, row in rows], [i for i, _ in rows])


def _separator(lines: Sequence[str]) -> str:
    """What separates cells: what all lines have equally often."""
    for mark in ("\t", ";", ","):
        counts = {line.count(mark) for line in lines}
        if len(counts) == 1 and counts != {0}:
            return mark
    return "," if any("," in line for line in lines) or not lines else " "


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = next(csv.reader([line], delimiter=separator))
    if separator == ";":
        cells = [re.sub(r"^(\s*[+-]?\d*),(\d+)", r"\1.\2", cell) for cell in cells]
    return cells


def _is_number(cell: str) -> bool:
    if cell.strip().lower() in _EMPTY:
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _told_by_comments(comments: Sequence[str], count: int) -> Sequence[str]:
    """Names of columns in the last comment that has as many words."""
    for line in reversed(comments):
        text = line.lstrip().lstrip("#")
        for separator in (",", ";", "\t", " "):
            words = _cells(text, separator)
            if len(words) == count and len({word.strip() for word in words}) == count:
                return words
    return ()
