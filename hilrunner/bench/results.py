"""What a benchmark hands over: tables of rows for people, the same numbers in SI-named keys for machines."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.histogram_scale import merge, percentiles
from hilrunner.base.units import NS_PER_US

SHOWN = ("p50", "p99", "p999", "max")  # of the names in records.STATISTIC_NAMES
HEADINGS = ("p50 us", "p99 us", "p99.9 us", "max us")


@dataclass(frozen=True)
class Table:
    """One table of a benchmark.

    Args:
        key: name in the JSON. title: what was measured, where and how often.
        columns: heading of each column of `rows` (the first column names the row).
        rows: cells; a float is printed with three significant digits, None as a dash.
        notes: what to know when reading it.
        values: the same results by name with the unit last, for JSON.
    """

    key: str
    title: str
    columns: tuple[str, ...]
    rows: list[tuple]
    notes: list[str] = field(default_factory=list)
    values: dict = field(default_factory=dict)

    def as_dict(self) -> dict:
        """For JSON."""
        rows = [dict(zip(self.columns, row, strict=True)) for row in self.rows]
        return {"title": self.title, "rows": rows, "notes": self.notes, **self.values}


def cell(value: object) -> str:
    """One cell: three significant digits and no exponent where a reader would not want one."""
    if value is None:
        return "-"
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if value != value:
        return "-"
    size = abs(value)
    if size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    if size >= 0.1 or size == 0:
        return f"{value:.2f}"
    return f"{value:.3g}"


def text(table: Table) -> str:
    """A table as aligned text: first column left, the others right."""
    cells = [[cell(value) for value in row] for row in table.rows]
    widths = [max([len(head), *(len(row[i]) for row in cells)]) for i, head in enumerate(table.columns)]
    lines = [table.title, _line(list(table.columns), widths), "  ".join("-" * width for width in widths)]
    lines += [_line(row, widths) for row in cells]
    lines += [f"  {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


def _line(words: list[str], widths: list[int]) -> str:
    aligned = [words[0].ljust(widths[0])] + [
        word.rjust(width) for word, width in zip(words[1:], widths[1:], strict=True)
    ]
    return "  ".join(aligned).rstrip()


def pooled_us(taken: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[float]:
    """SHOWN quantiles, us, of all samples in several pairs of histogram row and extreme row."""
    pooled = percentiles(*merge(np.stack([row for row, _ in taken]), np.stack([extreme for _, extreme in taken])))
    return [pooled[name] / NS_PER_US for name in SHOWN]
