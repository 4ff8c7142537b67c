"""Creep: hours are held on a crane, so what a surrogate adds to the drift of a rod at command 0 must be nothing."""

from dataclasses import dataclass

import numpy as np

from hilrunner.base.units import M_PER_MM
from hilrunner.plant.step import SCRATCH_SIZE, AxisPlant, advance_many, assemble, initial_state
from hilrunner.reproduce import cases
from hilrunner.reproduce.compare import surrogate_words
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, PERIOD_S, Models, exact_twin, reference_of
from hilrunner.reproduce.rows import Detail, Part, Row

HOLD_S, QUICK_HOLD_S = 600.0, 60.0
_CHUNK = 20_000
_MOVE_PERIODS, _SETTLE_PERIODS = 2000, 3000


@dataclass(frozen=True)
class Hold:
    """How a rod moved while it was held."""

    drift_m: float  # end less start
    rate_mps: float  # over the last quarter


def hold(plant: AxisPlant, start: np.ndarray, seconds: float) -> Hold:
    """A plant at command 0 from a state."""
    model = assemble([plant], PERIOD_S)
    state, scratch = start.copy(), np.zeros(SCRATCH_SIZE)
    total = round(seconds / PERIOD_S)
    positions = [float(start[0])]
    for first in range(0, total, _CHUNK):
        count = min(_CHUNK, total - first)
        states, flags = np.full((count, 10), np.nan), np.zeros(count, np.int64)
        advance_many(model, 0, np.zeros(count), np.ones(count), PERIOD_S, state, scratch, states, flags)
        positions.append(float(states[-1, 0]))
    at = max(0, len(positions) - 1 - max(1, len(positions) // 4))
    span_s = (len(positions) - 1 - at) * min(_CHUNK, total) * PERIOD_S
    return Hold(positions[-1] - positions[0], (positions[-1] - positions[at]) / span_s)


def starts_of(plant: AxisPlant, position_m: float) -> dict[str, np.ndarray]:
    """States to hold from: at rest, and settled after a lift, both of the exact model with spools without mass."""
    exact = exact_twin(plant)
    rest = initial_state(exact, position_m)
    commands = np.concatenate([np.full(_MOVE_PERIODS, 0.6), np.zeros(_SETTLE_PERIODS)])
    count = len(commands)
    state, states = rest.copy(), np.zeros((count, 10))
    advance_many(
        assemble([exact], PERIOD_S), 0, commands, np.ones(count), PERIOD_S, state, np.zeros(SCRATCH_SIZE), states,
        np.zeros(count, np.int64),
    )  # fmt: skip
    return {"from rest": rest, "after a lift": states[-1]}


def creep_part(models: Models, quick: bool) -> Part:
    """What the networks add to the drift of a held rod, from the same consistent states."""
    seconds = QUICK_HOLD_S if quick else HOLD_S
    part = Part("creep", f"Creep at command 0: {seconds:g} s held from one consistent state")
    details = []
    for circuit, profile, start_m, file in (
        ("paper", "paper", cases.PAPER_START_M, PAPER_FLOW),
        ("lift", "amc-lift", cases.LIFT_START_M, LIFT_FLOW),
    ):
        reference = reference_of(profile)
        surrogate = models.surrogate(file, reference)
        for words, start in starts_of(surrogate, start_m).items():
            mine = hold(surrogate, start, seconds)
            twin, full = hold(exact_twin(surrogate), start, seconds), hold(reference, start, seconds)
            added_mm = abs(mine.drift_m - twin.drift_m) / M_PER_MM
            label = f"{surrogate_words(surrogate)} against the same reduced model solved exactly; {words}"
            what = f"circuit {circuit}: drift added by the networks in {seconds:g} s, {words}"
            key = f"creep.{circuit}.{words.replace(' ', '_')}"
            part.rows.append(Row(key, what, added_mm, "mm", label, must=0.0, aim=0.0))
            for engine, one in (("surrogate", mine), ("reduced model, exact", twin), ("full model", full)):
                details.append((circuit, words, engine, one.drift_m / M_PER_MM, one.rate_mps / M_PER_MM))
    reference = reference_of("paper")
    own = models.surrogate(PAPER_RATES, reference)
    start = initial_state(reference, cases.PAPER_START_M)
    mine, full = hold(own, start, 10.0), hold(reference, start, 10.0)
    rate_mmps = abs(mine.drift_m - full.drift_m) / 10.0 / M_PER_MM
    label = f"{surrogate_words(own)}; from rest, against the full model"
    what = "circuit paper, the article's own form: creep over the first 10 s of a hold"
    part.rows.append(Row("creep.paper_own_form", what, rate_mmps, "mm/s", label, source="not reported"))
    details.append(("paper", "from rest, 10 s", "own form", mine.drift_m / M_PER_MM, mine.rate_mps / M_PER_MM))
    part.details.append(
        Detail("Drift of the held rod", ("circuit", "start", "engine", "drift mm", "late rate mm/s"), details)
    )
    part.notes.append(
        "the full model's spools have mass: its own drift differs from the reduced one's by what that does"
    )
    return part
