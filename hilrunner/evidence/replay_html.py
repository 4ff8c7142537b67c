"""The replay as one self-contained HTML page: the article's Figures 7 and 8 (10 and 11 under a perturbed load) for this run."""

import html

import numpy as np

from hilrunner.base.units import PA_PER_MPA
from hilrunner.evidence import page
from hilrunner.evidence.replay import Replay, speed
from hilrunner.evidence.replay_dae import QUANTITIES, AxisDae
from hilrunner.evidence.replay_exact import exact_sentence
from hilrunner.evidence.replay_text import figure_rows, place_rows
from hilrunner.evidence.report_html import span, verdict_chip, verdict_table
from hilrunner.evidence.svg import Axis, Chart

_POINTS = 1200
_STRETCHES = 600


@np.errstate(all="ignore")
def replay_html(replay: Replay) -> str:
    """The whole document."""
    sections = [page.section("Verdict", verdict_table(replay.verdict))]
    if replay.exact is not None:
        sections.append(page.section("Bit-exact replay", _exact(replay)))
    for axis in replay.axes:
        sections.append(page.section(f"Axis {axis.axis} beside the full model", _axis(axis, replay)))
    if replay.notes:
        sections.append(page.section("What the log lacks", page.bullets(replay.notes, "warn")))
    sections.append(page.section("Provenance", page.facts(replay.facts.provenance.items())))
    return page.page(f"Replay: {replay.path.name}", _lead(replay), sections)


def _lead(replay: Replay) -> str:
    chips, tiles = [verdict_chip(replay.verdict)], []
    exact = replay.exact
    if exact is not None:
        chips.append(page.chip("bit-identical", "good") if exact.identical else page.chip("not bit-identical", "bad"))
        tiles.append(("ticks compared bit by bit", f"{exact.compared_ticks}", f"of {exact.total_ticks}"))
        tiles.append(("bit-exact replay", f"{exact.speed_factor:.0f} ×", "faster than real time"))
    out = sum(axis.out_of_tolerance for axis in replay.axes)
    if replay.axes:
        chips.append(
            page.chip("within tolerance", "good") if not out else page.chip(f"{out} ticks out of tolerance", "bad")
        )
        axis = replay.axes[0]
        tiles.append(("IDA on the DAE", f"{speed(axis.simulated_s, axis.ida_wall_s):.1f} ×", "faster than real time"))
        for quantity in ("chamber 1 pressure", "chamber 2 pressure", "rod position"):
            worst = max((one.figure(quantity, "run - IDA") for one in replay.axes), key=lambda f: np.nan_to_num(f.max))
            tiles.append((f"worst {quantity}", f"{worst.max:.2g} {worst.unit}", f"RMS {worst.rms:.2g} {worst.unit}"))
    told = f'<span class="quiet">profile {html.escape(replay.facts.profile_name)}</span>'
    return f"<p>{' '.join(chips)} {told}</p>" + page.tiles(tiles)


def _exact(replay: Replay) -> str:
    exact = replay.exact
    text = page.paragraph(exact_sentence(exact) + ".")
    if exact.differing:
        rows = [(name, str(count)) for name, count in exact.differing.items()]
        text += page.table(("field", "ticks that differ"), rows)
    lead = "The logged frames went through the same compiled cycle with the profile, DBC and model attached to the log."
    return page.paragraph(lead, "quiet") + text + (page.bullets(exact.notes) if exact.notes else "")


def _axis(axis: AxisDae, replay: Replay) -> str:
    rows, places = figure_rows(axis), place_rows(axis)
    perturbed = "The load is perturbed, as in the article's Figures 9 to 11. " if replay.perturbed_load else ""
    lead = (
        f"{perturbed}Run: what the bench computed. IDA: SUNDIALS on the full differential-algebraic model over the same commands, "
        "free-running from the same start. Reference: the compiled first-principle model, likewise; one step: from the run's own last state. "
        "Normalised by the range the quantity covers in the truth."
    )
    parts = [page.paragraph(lead, "quiet"), page.table(rows[0], rows[1:], numbers_from=2)]
    parts.append(page.figures(*_trajectories(axis)))
    parts.append(page.figures(*_errors(axis, replay)))
    if axis.places:
        parts.append("<h3>Where in the training range the worst error sits</h3>")
        parts.append(page.table(places[0], places[1:], numbers_from=2))
        parts.append(page.figures(*[chart for place in axis.places if (chart := _place_chart(place))]))
    return "".join(parts) + (page.bullets(axis.notes, "warn") if axis.notes else "")


def _trajectories(axis: AxisDae) -> list[str]:
    """Run and truth over each other: the article's Figures 7 and 10, with position, speed and command."""
    pick = np.unique(np.linspace(0, len(axis.tick) - 1, min(_POINTS, len(axis.tick))).astype(np.int64))
    times = axis.times_s[pick]
    charts = []
    for quantity, (place, factor, unit) in QUANTITIES.items():
        run, ida = axis.run[pick, place] / factor, axis.ida[pick, place] / factor
        chart = Chart(quantity.capitalize(), Axis("time, s", float(times[0]), float(times[-1])), span(unit, [run, ida]))
        charts.append(chart.line(times, ida, 2, "IDA").line(times, run, 1, "run", dashed=True).svg())
    valve = Chart("Valve command", Axis("time, s", float(times[0]), float(times[-1])), Axis("-1 … 1", -1.05, 1.05))
    charts.append(valve.line(times, axis.valve[pick], 3).svg())
    return charts


def _errors(axis: AxisDae, replay: Replay) -> list[str]:
    """Absolute errors over time: the article's Figures 8 and 11; the largest in each stretch, nothing is smoothed away."""
    charts = []
    limits = {
        "MPa": (replay.tolerance.pressure_tolerance_mpa, "tolerance"),
        "mm": (replay.tolerance.position_tolerance_mm, "tolerance"),
    }
    for quantity, (place, factor, unit) in QUANTITIES.items():
        series = {
            "run - IDA": axis.run[:, place] - axis.ida[:, place],
            "reference - IDA": axis.reference[:, place] - axis.ida[:, place],
            "one step": axis.one_step_error[:, place],
        }
        times, lines = _largest(axis.times_s, {name: np.abs(one) / factor for name, one in series.items()})
        top = max((float(np.nanmax(one)) for one in lines.values() if np.isfinite(one).any()), default=0.0)
        if top <= 0:
            continue
        x = Axis("time, s", float(times[0]), float(times[-1]))
        chart = Chart(f"Absolute error of the {quantity}", x, Axis(unit, top * 1e-6, top * 3, log=True))
        for colour, (name, one) in enumerate(lines.items(), start=1):
            chart.line(times, np.where(one > 0, one, np.nan), colour, name)
        if unit in limits:
            chart.level(*limits[unit])
        charts.append(chart.svg())
    return charts


def _largest(times: np.ndarray, series: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    starts = np.unique(np.linspace(0, len(times), min(_STRETCHES, len(times)), endpoint=False).astype(np.int64))
    return times[starts], {name: np.fmax.reduceat(one, starts) for name, one in series.items()}


def _place_chart(place) -> str:
    """Largest one-step pressure error along one input of one network."""
    worst = place.worst_in_bin / PA_PER_MPA
    if not np.isfinite(worst).any() or not np.nanmax(worst) > 0:
        return ""
    top = float(np.nanmax(worst))
    y = Axis("MPa in one step", top * 1e-5, top * 2, log=True)
    heights = np.where(np.isfinite(worst) & (worst > 0), worst, y.low)
    chart = Chart(f"{place.network}: {place.name}", Axis(place.name, place.low, place.high), y)
    chart.steps(place.bin_edges, heights)
    if place.low <= place.at_worst <= place.high:
        chart.points([place.at_worst], [top], 4, "worst")
    return chart.svg()
