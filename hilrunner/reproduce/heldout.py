"""Runs nobody tuned for: random schedules, load factors and starting positions, drawn from fixed seeds."""

import numpy as np

from hilrunner.base import status
from hilrunner.reproduce import cases
from hilrunner.reproduce.compare import against, outside_training, truth_of
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, Models, exact_twin
from hilrunner.reproduce.rows import Detail, Part, Row
from hilrunner.reproduce.trajectories import LIFT_LIMITS, PAPER_LIMITS, Limits

RUNS, SECONDS = 12, 20.0
QUICK_RUNS, QUICK_SECONDS = 4, 6.0


def heldout_part(models: Models, quick: bool) -> Part:
    """Worst and median error over the held-out runs of both circuits."""
    runs, seconds = (QUICK_RUNS, QUICK_SECONDS) if quick else (RUNS, SECONDS)
    title = f"Held out: {runs} random runs a circuit, {seconds:g} s each (schedule, load factor 0.7 to 1.1, start 0.2 to 1.0 m)"
    part = Part("heldout", title)
    for profile, file, limits in (("paper", PAPER_FLOW, PAPER_LIMITS), ("amc-lift", LIFT_FLOW, LIFT_LIMITS)):
        _circuit(part, models, profile, file, limits, runs, seconds)
    if quick:
        part.notes.append(f"quick: {QUICK_RUNS} runs of {QUICK_SECONDS:g} s instead of {RUNS} of {SECONDS:g} s")
    return part


def _circuit(part: Part, models: Models, profile: str, file: str, limits: Limits, runs: int, seconds: float) -> None:
    rows, found, label, circuit, left = [], {"p1": [], "p2": [], "x": []}, "", "", 0
    for number in range(runs):
        case, scale, start_m = cases.held_out(profile, number, seconds)
        circuit = status.CIRCUIT_NAMES[case.plant.circuit]
        truth, words, _ = truth_of(case, None)
        one = against(case, models.surrogate(file, case.plant), truth, words)
        label = one.label
        left += outside_training(one.ran)
        twin = against(case, exact_twin(one.surrogate), truth, words)
        errors = {symbol: one.errors[symbol].max for symbol in found}
        for symbol, value in errors.items():
            found[symbol].append(value)
        without = (twin.errors[symbol].max for symbol in found)
        rows.append((number, scale, start_m * 1e3, *errors.values(), *without))
    for symbol, values in found.items():
        must, aim = limits.of(symbol)
        unit = "mm" if symbol == "x" else "MPa"
        for name, value, held in (("worst", max(values, key=_size), True), ("median", float(np.median(values)), False)):
            what = f"circuit {circuit}, {runs} held-out runs: {name} of the largest errors of {symbol}"
            key = f"heldout.{circuit}.{name}.{symbol}"
            limit = (must, aim) if held else (None, None)
            part.rows.append(Row(key, what, value, unit, label, must=limit[0], aim=limit[1]))
    head = ("run", "load factor", "start mm", "p1 MPa", "p2 MPa", "x mm", "p1 no network", "p2", "x")
    part.details.append(Detail(f"Held-out runs, circuit {circuit}", head, rows))
    part.notes.append(
        f"circuit {circuit}, no network: the same reduced model solved exactly, so what the reduction alone costs"
    )
    part.notes.append(f"circuit {circuit}: {left} of {runs} runs left the range of training somewhere")


def _size(value: float) -> float:
    """For a maximum in which what is not a number comes first."""
    return float("inf") if value != value else value
