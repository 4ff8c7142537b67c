"""The article's figures as SVG: load over position, command, trajectories over each other, errors over time, training."""

import numpy as np

from hilrunner.base.units import M_PER_MM, N_PER_KN
from hilrunner.evidence.report_html import span
from hilrunner.evidence.svg import Axis, Chart
from hilrunner.plant.initial import static_load_n
from hilrunner.plant.load import LoadTable
from hilrunner.reproduce.compare import QUANTITIES, Comparison

_POINTS = 900
_STRETCHES = 450
NAMES = {"p1": "chamber 1 pressure", "p2": "chamber 2 pressure", "x": "rod position", "v": "rod velocity"}


def load_chart(title: str, table: LoadTable, stroke_m: float) -> str:
    """Load force over rod position (Figures 5 and 9)."""
    x = np.linspace(0.0, stroke_m, 201)
    force = np.array([static_load_n(table, float(at)) for at in x]) / N_PER_KN
    chart = Chart(title, Axis("rod position, mm", 0.0, stroke_m / M_PER_MM), span("kN", [force]))
    return chart.line(x / M_PER_MM, force, 1).svg()


def command_chart(title: str, one: Comparison) -> str:
    """Valve command over time (Figure 6)."""
    pick = _picked(len(one.case.commands))
    times = one.case.times_s[pick]
    chart = Chart(title, _time_axis(times), Axis("command, -1 … 1", -1.05, 1.05))
    return chart.line(times, one.case.commands[pick], 3).svg()


def trajectory_charts(title: str, one: Comparison) -> list[str]:
    """Surrogate and truth over each other (Figures 7 and 10)."""
    pick = _picked(len(one.truth))
    times = one.case.times_s[pick]
    charts = []
    for symbol, (place, factor, unit) in QUANTITIES.items():
        mine, truth = one.ran.states[pick, place] / factor, one.truth[pick, place] / factor
        chart = Chart(f"{title}: {NAMES[symbol]}", _time_axis(times), span(unit, [truth]))
        charts.append(chart.line(times, truth, 2, "truth").line(times, mine, 1, "surrogate", dashed=True).svg())
    return charts


def error_charts(title: str, runs: dict[str, Comparison], article: dict[str, float] | None = None) -> list[str]:
    """Absolute errors over time (Figures 8 and 11): the largest in each stretch, nothing is smoothed away.

    runs: name in the legend -> comparison, over the same case. article: its largest error by symbol, drawn as a level.
    """
    charts = []
    first = next(iter(runs.values()))
    starts = np.unique(np.linspace(0, len(first.truth), _STRETCHES, endpoint=False).astype(np.int64))
    times = first.case.times_s[starts]
    for symbol, (place, factor, unit) in QUANTITIES.items():
        lines = {}
        for name, one in runs.items():
            error = np.abs(one.ran.states[:, place] - one.truth[:, place]) / factor
            lines[name] = np.fmax.reduceat(error, starts)
        level = (article or {}).get(symbol)
        chart = _log_chart(f"{title}: error of the {NAMES[symbol]}", unit, times, lines, level)
        charts.append(chart)
    return [chart for chart in charts if chart]


def _log_chart(title: str, unit: str, times: np.ndarray, lines: dict[str, np.ndarray], level: float | None) -> str:
    top = max((float(np.nanmax(one)) for one in lines.values() if np.isfinite(one).any()), default=0.0)
    if not top > 0.0:
        return ""
    top = max(top, level or 0.0)
    chart = Chart(title, _time_axis(times), Axis(unit, top * 1e-8, top * 3.0, log=True))
    for colour, (name, one) in enumerate(lines.items(), start=1):
        chart.line(times, np.where(one > 0.0, one, np.nan), colour, name)
    if level:
        chart.level(level, "article's largest")
    return chart.svg()


def training_chart(title: str, curve: list[dict]) -> str:
    """Normalised mean square error over iterations."""
    iteration = np.array([row["iteration"] for row in curve], np.float64)
    train = np.array([row["train"] for row in curve])
    validation = np.array([row["validation"] for row in curve])
    both = np.concatenate([train, validation])
    both = both[np.isfinite(both) & (both > 0.0)]
    if not len(both):
        return ""
    y = Axis("normalised mean square error", float(both.min()) / 3.0, float(both.max()) * 3.0, log=True)
    chart = Chart(title, Axis("iteration", 0.0, float(iteration[-1])), y)
    return chart.line(iteration, train, 1, "training").line(iteration, validation, 2, "validation", True).svg()


def _picked(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(_POINTS, count)).astype(np.int64))


def _time_axis(times: np.ndarray) -> Axis:
    return Axis("time, s", float(times[0]), float(times[-1]))
