"""Tables as text: commas, or semicolons and tabs with decimal commas as spreadsheets write them where the comma is the decimal sign."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass

_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf(inity)?)", re.IGNORECASE)
_SEPARATOR_LINE = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)  # Excel's own first line
_SHOWN_CHARACTERS = 80


@dataclass(frozen=True)
class Table:
    """The header's names and the rows below it, each with the number of its line in the file."""

    header: list[str]
    header_line: int  # 0: the text holds no row at all
    rows: list[tuple[int, list[str]]]


def read_table(text: str) -> Table:
    """Split a text: blank lines and lines that begin with `#` are left out, and so are the empty columns behind the last name.

    Raises:
        ValueError: a quoted cell does not end.
    """
    rows = list(_rows(text))
    if not rows:
        return Table([], 0, [])
    header_line, header = rows[0]
    header = _without_empty_end(header)
    return Table(header, header_line, [(line, _shortened(cells, len(header))) for line, cells in rows[1:]])


def number(cell: str) -> float:
    """The number in a cell, with a decimal point or a decimal comma; ValueError for anything else (also `1.234,5`)."""
    cell = cell.strip()
    if not _NUMBER.fullmatch(cell):
        raise ValueError(f"{cell!r} is not a number")
    return float(cell.replace(",", "."))


def shown(cells: list[str]) -> str:
    """A row as an error message shows it."""
    text = " | ".join(cells)
    return repr(text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "…")


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    lines = text.split("\n")
    asked = _SEPARATOR_LINE.fullmatch(lines[0])
    if asked:
        lines[0] = ""
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    delimiter = asked[1] if asked else next((one for one in ";\t," if one in first), ",")
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            cells = [cell.strip() for cell in cells]
            if any(cells) and not cells[0].startswith("#"):
                yield reader.line_num, cells
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None


def _without_empty_end(cells: list[str]) -> list[str]:
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _shortened(cells: list[str], count: int) -> list[str]:
    """Without what a spreadsheet adds behind the last named column, as long as it is empty."""
    return cells[:count] if not any(cells[count:]) else cells
