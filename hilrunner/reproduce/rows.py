"""What a part of the reproduction hands over: rows with a limit each, further tables, charts, notes; JSON is a view of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

MUST_HOLDS, MUST_FAILS, NO_MUST = "met", "NOT MET", "-"


@dataclass(frozen=True)
class Row:
    """One figure beside the article's and beside its limits.

    Args:
        key: unique among all rows, for machines.
        what: the quantity in words, without its unit. measured, unit: None where it could not be measured.
        label: what was run: circuit, engine, compiled or interpreted, solver, tolerance.
        article: the article's figure in the same unit; source: table or figure it stands in.
        must, aim: limits in the same unit; None: only told.
        at_least: a larger figure is the better one.
        timing: differs from run to run (a time or a size of memory).
    """

    key: str
    what: str
    measured: float | None
    unit: str
    label: str
    article: float | None = None
    source: str = ""
    must: float | None = None
    aim: float | None = None
    at_least: bool = False
    timing: bool = False

    def meets(self, limit: float | None) -> bool | None:
        """Whether the figure is within a limit; None without a limit; what is not a number meets none."""
        if limit is None:
            return None
        if self.measured is None or not math.isfinite(self.measured):
            return False
        return self.measured >= limit if self.at_least else self.measured <= limit

    @property
    def verdict(self) -> str:
        """One word on the must."""
        held = self.meets(self.must)
        return NO_MUST if held is None else (MUST_HOLDS if held else MUST_FAILS)

    @property
    def aim_verdict(self) -> str:
        """One word on the aim."""
        held = self.meets(self.aim)
        return "-" if held is None else ("reached" if held else "not reached")

    def as_dict(self) -> dict:
        """For JSON; what is not finite becomes null."""
        return {
            "key": self.key,
            "what": self.what,
            "measured": _finite(self.measured),
            "unit": self.unit,
            "label": self.label,
            "article": self.article,
            "source": self.source,
            "must": self.must,
            "aim": self.aim,
            "at_least": self.at_least,
            "timing": self.timing,
            "must_met": self.meets(self.must),
            "aim_met": self.meets(self.aim),
        }


@dataclass(frozen=True)
class Detail:
    """A further table of a part: plain cells."""

    title: str
    head: tuple[str, ...]
    rows: list[Sequence[object]]

    def as_dict(self) -> dict:
        """For JSON."""
        return {
            "title": self.title,
            "head": list(self.head),
            "rows": [[_finite(cell) for cell in row] for row in self.rows],
        }


@dataclass
class Part:
    """One part of the reproduction."""

    name: str
    title: str
    rows: list[Row] = field(default_factory=list)
    details: list[Detail] = field(default_factory=list)
    charts: list[str] = field(default_factory=list)  # SVG figures
    notes: list[str] = field(default_factory=list)
    wall_s: float = 0.0

    def as_dict(self) -> dict:
        """For JSON: everything but the charts."""
        return {
            "name": self.name,
            "title": self.title,
            "rows": [row.as_dict() for row in self.rows],
            "details": [detail.as_dict() for detail in self.details],
            "notes": self.notes,
            "wall_s": self.wall_s,
        }


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def number(value: object) -> str:
    """Three significant digits for a float, a dash for nothing, anything else as it is."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if value != 0 and (abs(value) < 1e-3 or abs(value) >= 1e6):
        return _short_exponent(f"{value:.2e}")
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def printed(value: float | None) -> str:
    """A given figure (the article's, a limit) with as many digits as it was given."""
    return "-" if value is None else _short_exponent(f"{value:.5g}")


def _short_exponent(text: str) -> str:
    """4.96e-06 as 4.96e-6."""
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if mark else text
