"""Charts as inline SVG text: scales, axes, lines, steps, points, bars. Colours come from the page's style sheet."""

import html
import math
from dataclasses import dataclass, field

import numpy as np

_LARGEST = 1e100
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 14, 12, 44
_LOG_STEPS = (1, 2, 5)


@dataclass
class Axis:
    """A scale with its title; `low` and `high` in data units, above 0 on a log axis."""

    title: str
    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        self.low, self.high = _drawable(self.low), _drawable(self.high)
        if self.log:
            self.low = max(self.low, 1e-300)
            self.high = max(self.high, self.low * 1.1)
        elif not self.high > self.low:
            middle, spread = self.low, abs(self.low) * 0.05 or 1.0
            self.low, self.high = middle - spread, middle + spread

    def place(self, values) -> np.ndarray:
        """Values as a share of the axis, 0..1, clipped to it."""
        data = np.asarray(values, np.float64)
        if self.log:
            share = (np.log(np.maximum(data, self.low)) - math.log(self.low)) / math.log(self.high / self.low)
        else:
            share = (data - self.low) / (self.high - self.low)
        return np.clip(share, 0.0, 1.0)

    def ticks(self, count: int = 6) -> list[float]:
        """Round values to mark."""
        if self.log and self.high > 4 * self.low:
            return self._log_ticks()
        step = nice_step((self.high - self.low) / count)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]

    def _log_ticks(self) -> list[float]:
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        steps = _LOG_STEPS if len(decades) <= 3 else (1,)
        stride = max(1, math.ceil(len(decades) / 7))
        marks = [m * 10.0**d for d in list(decades)[::stride] for m in steps]
        return [mark for mark in marks if self.low * 0.999 <= mark <= self.high * 1.001]


def _drawable(value: float) -> float:
    """An end of an axis that can be subtracted from and divided by any other; a damaged log holds numbers of any size."""
    return 0.0 if math.isnan(value) else max(-_LARGEST, min(float(value), _LARGEST))


def nice_step(raw: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below `raw`."""
    if not raw > 0 or not math.isfinite(raw):
        return 1.0
    power = 10.0 ** math.floor(math.log10(raw))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9))


def label(value: float) -> str:
    """A tick's value in few characters."""
    if value == 0:
        return "0"
    size = abs(value)
    if size >= 1e6 or size < 1e-3:
        mantissa, exponent = f"{value:.0e}".split("e")
        power = f"10{_superscript(int(exponent))}"
        return power if mantissa == "1" else f"{mantissa}·{power}"
    return f"{value:.6g}"


def _superscript(number: int) -> str:
    return str(number).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


@dataclass
class Chart:
    """One figure; add marks, then `svg()`."""

    title: str
    x: Axis
    y: Axis
    width: int = 520
    height: int = 280
    _marks: list[str] = field(default_factory=list)
    _legend: list[tuple[str, str]] = field(default_factory=list)

    def line(self, x, y, colour: int = 1, name: str = "", dashed: bool = False) -> "Chart":
        """A line through points; a NaN breaks it."""
        style = f"s{colour}" + (" dash" if dashed else "")
        self._marks.append(f'<path class="line {style}" d="{self._path(x, y)}"/>')
        self._note(style, name)
        return self

    def steps(self, edges, heights, colour: int = 1, name: str = "") -> "Chart":
        """A filled staircase: heights[k] between edges[k] and edges[k + 1]."""
        heights = np.asarray(heights, np.float64)
        x = np.repeat(np.asarray(edges, np.float64), 2)
        y = np.concatenate(([self.y.low], np.repeat(heights, 2), [self.y.low]))
        self._marks.append(f'<path class="area s{colour}" d="{self._path(x, y)}Z"/>')
        self._note(f"s{colour}", name)
        return self

    def points(self, x, y, colour: int = 4, name: str = "", hints: list[str] | None = None) -> "Chart":
        """Small circles, each with a hint shown on hovering."""
        at_x, at_y = self._x(x), self._y(y)
        for k in range(len(at_x)):
            hint = f"<title>{html.escape(hints[k])}</title>" if hints else ""
            self._marks.append(
                f'<circle class="dot s{colour}" cx="{at_x[k]:.1f}" cy="{at_y[k]:.1f}" r="3.4">{hint}</circle>'
            )
        self._note(f"s{colour}", name)
        return self

    def level(self, y: float, name: str, colour: int = 4) -> "Chart":
        """A horizontal line with its name on it."""
        if not self.y.low <= y <= self.y.high:
            return self
        at = float(self._y([y])[0])
        self._marks.append(
            f'<path class="line s{colour} dash" d="M{_LEFT},{at:.1f}H{self.width - _RIGHT}"/>'
            f'<text class="note" x="{self.width - _RIGHT - 4}" y="{at - 4:.1f}" text-anchor="end">{html.escape(name)}</text>'
        )
        return self

    def svg(self) -> str:
        """The figure, with title and legend as text so that it can be read aloud."""
        body = "".join([self._grid(), *self._marks])
        legend = "".join(f'<span class="key {style}"><i></i>{html.escape(name)}</span>' for style, name in self._legend)
        return (
            f'<figure><figcaption>{html.escape(self.title)}<span class="legend">{legend}</span></figcaption>'
            f'<svg viewBox="0 0 {self.width} {self.height}" role="img" aria-label="{html.escape(self.title)}">{body}</svg></figure>'
        )

    def _note(self, style: str, name: str) -> None:
        if name:
            self._legend.append((style, name))

    def _x(self, values) -> np.ndarray:
        return _LEFT + self.x.place(values) * (self.width - _LEFT - _RIGHT)

    def _y(self, values) -> np.ndarray:
        return self.height - _BOTTOM - self.y.place(values) * (self.height - _TOP - _BOTTOM)

    def _path(self, x, y) -> str:
        good = np.isfinite(np.asarray(x, np.float64)) & np.isfinite(np.asarray(y, np.float64))
        at_x, at_y = self._x(np.where(good, x, self.x.low)), self._y(np.where(good, y, self.y.low))
        parts, pen_up = [], True
        for k in range(len(at_x)):
            if good[k]:
                parts.append(f"{'M' if pen_up else 'L'}{at_x[k]:.1f},{at_y[k]:.1f}")
            pen_up = not good[k]
        return "".join(parts)

    def _grid(self) -> str:
        right, bottom = self.width - _RIGHT, self.height - _BOTTOM
        parts = [f'<rect class="frame" x="{_LEFT}" y="{_TOP}" width="{right - _LEFT}" height="{bottom - _TOP}"/>']
        for value in self.x.ticks(8 if self.width > 700 else 6):
            at = float(self._x([value])[0])
            parts.append(f'<path class="grid" d="M{at:.1f},{_TOP}V{bottom}"/>')
            parts.append(f'<text x="{at:.1f}" y="{bottom + 15}" text-anchor="middle">{label(value)}</text>')
        for value in self.y.ticks(5):
            at = float(self._y([value])[0])
            parts.append(f'<path class="grid" d="M{_LEFT},{at:.1f}H{right}"/>')
            parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{label(value)}</text>')
        middle = (_TOP + bottom) / 2
        parts.append(
            f'<text class="title" x="{(_LEFT + right) / 2}" y="{self.height - 8}" text-anchor="middle">{html.escape(self.x.title)}</text>'
        )
        parts.append(
            f'<text class="title" transform="translate(13 {middle}) rotate(-90)" text-anchor="middle">{html.escape(self.y.title)}</text>'
        )
        return "".join(parts)
