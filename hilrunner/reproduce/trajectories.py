"""Accuracy over whole runs: the article's lift (Tables 4 and 5, Figures 5 to 11), circuit lift, overrunning loads."""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import status
from hilrunner.plant.load import LoadTable
from hilrunner.reproduce import article, cases, charts
from hilrunner.reproduce.compare import QUANTITIES, Comparison, against, compare, outside_training
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, Models, exact_twin
from hilrunner.reproduce.rows import Detail, Part, Row, number

PAPER_RTOL, LIFT_RTOL = 1e-11, 1e-9


@dataclass(frozen=True)
class Limits:
    """Must and aim of one run: MPa of either chamber, mm of rod."""

    pressure: tuple[float | None, float | None] = (None, None)
    rod: tuple[float | None, float | None] = (None, None)

    def of(self, symbol: str) -> tuple[float | None, float | None]:
        """(must, aim) of a quantity."""
        if symbol in ("p1", "p2"):
            return self.pressure
        return self.rod if symbol == "x" else (None, None)


PAPER_LIMITS = Limits((1e-4, 1e-5))
LIFT_LIMITS = Limits((3e-3, 5e-4), (0.02, 0.005))
OVERRUN_LIMITS = Limits((5e-3, 5e-4), (0.05, 0.005))
ONLY_TOLD = Limits()
_TWIN = "no network"
_QUICK_LIFT_S, _QUICK_SEA_S = 20.0, 10.0


def error_rows(
    key: str, one: Comparison, limits: Limits, printed: dict[str, float] | None = None, source: str = ""
) -> list[Row]:
    """Largest errors of one comparison as rows."""
    rows = []
    for symbol in ("p1", "p2", "x"):
        must, aim = limits.of(symbol)
        error = one.errors[symbol]
        paper = (printed or {}).get(symbol)
        what = f"{one.case.words}: largest error of {symbol}"
        rows.append(
            Row(f"{key}.{symbol}", what, error.max, error.unit, one.label, paper, source if paper else "", must, aim)
        )
    return rows


def error_detail(title: str, runs: dict[str, Comparison]) -> Detail:
    """Largest, RMS and normalised errors of all quantities."""
    head = ("run", "quantity", "unit", "largest", "RMS", "largest / range", "RMS / range")
    rows = [
        (name, symbol, error.unit, error.max, error.rms, error.max_normalised, error.rms_normalised)
        for name, one in runs.items()
        for symbol, error in one.errors.items()
    ]
    return Detail(title, head, rows)


def paper_part(models: Models, quick: bool) -> Part:
    """The article's experiment with the shipped networks, and with the article's own form of network."""
    part = Part("paper", "The article's lift: 20 s, nominal and perturbed load (Figures 5 to 11, Tables 4 and 5)")
    printed = {False: (article.NOMINAL_ERROR_MPA, "Table 4"), True: (article.PERTURBED_ERROR_MPA, "Table 5")}
    runs: dict[str, Comparison] = {}
    own_rows = []
    for disturbed, (errors, table) in printed.items():
        case = cases.paper_lift(disturbed)
        flow = compare(case, models.surrogate(PAPER_FLOW, case.plant), PAPER_RTOL)
        own = against(case, models.surrogate(PAPER_RATES, case.plant), flow.truth, flow.truth_words)
        runs[f"{case.key}, flow"], runs[f"{case.key}, own form"] = flow, own
        part.rows += error_rows(f"paper.{case.key}", flow, PAPER_LIMITS, errors, table)
        own_rows += [
            Row(
                row.key,
                f"{row.what} (the article's own form)",
                row.measured,
                row.unit,
                row.label,
                row.article,
                row.source,
            )
            for row in error_rows(f"paper.{case.key}_own_form", own, ONLY_TOLD, errors, table)
        ]
        part.charts += _paper_charts(case.plant.load, flow, own, disturbed, errors)
    part.rows += own_rows
    part.details.append(error_detail("All errors over the 20 s", runs))
    part.notes.append(
        "own form: one network from (x, v, p1, p2, u) to both pressure rates, Eq. (10), trained over Table 2 with 1 L of dead "
        "volume; with the printed 20 mm^3 the rates cannot be learned at all (part networks). Load, valve profile and the "
        "article's missing parameters are ours (docs/paper.md), so its figures stand beside ours, not against the same run."
    )
    _note_flags(part, runs)
    return part


def _paper_charts(load: LoadTable, flow: Comparison, own: Comparison, disturbed: bool, errors: dict) -> list[str]:
    stroke_m = float(flow.case.plant.parameters["stroke_m"][0])
    figures = ("9", "10", "11") if disturbed else ("5", "7", "8")
    made = [charts.load_chart(f"As Figure {figures[0]}: {'perturbed ' * disturbed}load on the rod", load, stroke_m)]
    if not disturbed:
        made.append(charts.command_chart("As Figure 6: valve command", flow))
    made += charts.trajectory_charts(f"As Figure {figures[1]}", flow)
    made += charts.error_charts(f"As Figure {figures[2]}", {"flow (shipped)": flow, "own form": own}, errors)
    return made


def lift_part(models: Models, quick: bool) -> Part:
    """The two-way circuit over its schedule and in a sea."""
    part = Part("lift", "Circuit lift: lift, hold, lower, hold; and in a sea")
    runs = {}
    for made, seconds in ((cases.lift_hold_lower_hold(), _QUICK_LIFT_S), (cases.wave(), _QUICK_SEA_S)):
        case = made.shortened(seconds) if quick else made
        one = compare(case, models.surrogate(LIFT_FLOW, case.plant), LIFT_RTOL)
        runs |= {case.key: one, f"{case.key}, {_TWIN}": _twin_of(one)}
        part.rows += error_rows(f"lift.{case.key}", one, LIFT_LIMITS)
        part.charts += [charts.command_chart(f"{case.words}: command", one), *charts.trajectory_charts(case.key, one)]
        part.charts += charts.error_charts(case.key, {"surrogate": one})
    part.details.append(error_detail("All errors", runs))
    if quick:
        part.notes.append(f"quick: the first {_QUICK_LIFT_S:g} s and {_QUICK_SEA_S:g} s only")
    _note_flags(part, runs)
    return part


def overrun_part(models: Models, quick: bool) -> Part:
    """Loads that pull the rod: the counterbalance valve modulates, which the article never exercises."""
    part = Part("overrun", "Overrunning load: the counterbalance valve modulates")
    made = cases.overrunning()
    case = made.shortened(_QUICK_SEA_S) if quick else made
    lift = compare(case, models.surrogate(LIFT_FLOW, case.plant), LIFT_RTOL)
    part.rows += error_rows("overrun.lift", lift, OVERRUN_LIMITS)
    pulled = cases.paper_overrun()
    paper = compare(pulled, models.surrogate(PAPER_FLOW, pulled.plant), PAPER_RTOL)
    part.rows += error_rows("overrun.paper", paper, OVERRUN_LIMITS)
    runs = {"circuit lift": lift, "circuit paper": paper}
    twins = {f"{name}, {_TWIN}": _twin_of(one) for name, one in runs.items()}
    for name, one in runs.items():
        ratio = modulating_ratio(one)
        part.notes.append(f"{name}: the rod-side valve stands between 5 and 95 % open for {ratio:.0%} of the run")
        part.charts += charts.error_charts(name, {"surrogate": one})
    part.details.append(error_detail("All errors", runs | twins))
    if quick:
        part.notes.append(f"quick: circuit lift for the first {_QUICK_SEA_S:g} s only")
    _note_flags(part, runs)
    return part


def _twin_of(one: Comparison) -> Comparison:
    """What the reduction alone costs: the same run, the same truth, no network."""
    return against(one.case, exact_twin(one.surrogate), one.truth, one.truth_words)


def modulating_ratio(one: Comparison) -> float:
    """Share of the run in which spool 2 of the truth is neither shut nor on its open stop."""
    opening = one.truth[:, 5] / float(one.case.plant.parameters["spool_stroke_m"][0])
    return float(np.mean((opening > 0.05) & (opening < 0.95)))


def _note_flags(part: Part, runs: dict[str, Comparison]) -> None:
    for name, one in runs.items():
        if one.surrogate.networks is None:
            continue
        words = [f"{one.ran.served_ratio:.1%} of the evaluations by network"]
        if outside_training(one.ran):
            words.append("its range of training was left (there the exact functions answer; the own form extrapolates)")
        if one.ran.flags & status.FLAG_NOT_FINITE:
            words.append("the surrogate left the finite numbers")
        worst = max(one.errors[symbol].max for symbol in QUANTITIES if symbol.startswith("p"))
        part.notes.append(
            f"{name}: {', '.join(words)}; worst pressure error {number(worst)} MPa; truth took {one.truth_wall_s:.1f} s"
        )
