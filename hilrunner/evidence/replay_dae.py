"""The full model beside the run: IDA on the DAE and the compiled reference over the commands the surrogate got.

Two questions per quantity: how far had the run drifted from the truth by each tick (accumulated), and what did a single
period add (one-step, from the run's own last state). IDA answers the first; the compiled reference both, and IDA judges it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilrunner.base import records, status
from hilrunner.base.state_layout import STATE_SIZE
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.evidence.reader import Run
from hilrunner.evidence.training_range import InputPlace, places_in_range
from hilrunner.plant.ida import IdaSolver
from hilrunner.plant.model import AxisPlant
from hilrunner.record.crosscheck import QUANTITY_COUNT, check_periods, new_walk, reference_model
from hilrunner.setup.blocks import blocks

# quantity -> (place in base.state_layout, factor to the unit shown, unit shown); p1, p2, x, v of the article
QUANTITIES = {
    "chamber 1 pressure": (2, PA_PER_MPA, "MPa"),
    "chamber 2 pressure": (3, PA_PER_MPA, "MPa"),
    "rod position": (0, M_PER_MM, "mm"),
    "rod velocity": (1, M_PER_MM, "mm/s"),
}
COMPARISONS = ("run - IDA", "reference - IDA", "run - reference", "run - reference, one step")
# relative to the whole rod position: at 1e-9 it wandered by 6e-5 mm within a minute, at 1e-11 by 1e-8 mm (docs/plant.md),
# and most of the time goes into restarts at new inputs, not into accuracy
IDA_RTOL = 1e-11
_SEGMENT_PERIODS_MIN = 2

Progress = Callable[[float], None]  # share done, 0..1


@dataclass(frozen=True)
class ErrorFigures:
    """Errors of one quantity in one comparison, in `unit`; normalised by the range the quantity covers in the truth."""

    quantity: str
    comparison: str
    unit: str
    max: float
    rms: float
    max_normalised: float
    rms_normalised: float
    worst_tick: int


@dataclass(frozen=True)
class AxisDae:
    """One axis; arrays by logged tick, float64[n, 4] in SI, columns rod position, velocity, chamber 1, chamber 2 pressure."""

    axis: str
    tick: np.ndarray
    times_s: np.ndarray
    valve: np.ndarray
    run: np.ndarray
    reference: np.ndarray
    ida: np.ndarray  # float64[n, 10], base.state_layout; NaN where IDA gave up
    one_step_error: np.ndarray
    check: np.ndarray  # records.CHECK: the reference beside the run, for a log
    figures: list[ErrorFigures]
    places: list[InputPlace]
    out_of_tolerance: int
    first_out_tick: int | None
    ida_wall_s: float
    reference_wall_s: float
    simulated_s: float
    notes: tuple[str, ...]

    def figure(self, quantity: str, comparison: str) -> ErrorFigures:
        """One row of the table."""
        return next(f for f in self.figures if (f.quantity, f.comparison) == (quantity, comparison))


def replay_dae(
    log: Run,
    axis: str,
    index: int,
    plants: list[AxisPlant],
    engine_plant: AxisPlant,
    initial_state: np.ndarray,
    period_s: float,
    limits: np.ndarray,
    stimulus: np.ndarray | None = None,
    rtol: float = IDA_RTOL,
    tick_limit: int | None = None,
    progress: Progress = lambda share: None,
) -> AxisDae:
    """Solve one axis' full model over the logged commands and compare.

    Args:
        log: read with all columns. axis, index: the axis and its place in the profile.
        plants: reference plants of every axis. engine_plant: the axis' plant as the run had it (its networks' range).
        initial_state: float64[10] before the first tick. limits: float64[12], tolerances as in record.crosscheck.
        stimulus: float64[tick], the axis' commands where a stimulus drove the run, NaN where not known; None: frames did.
        tick_limit: compare the first so many logged ticks only.
    """
    notes: list[str] = []
    stimulus = np.zeros(0) if stimulus is None else np.ascontiguousarray(stimulus)
    command, state, skipped = _rows(log, axis, tick_limit)
    commands, scales, period_of_row, starts = expand_inputs(command, state, skipped, stimulus)
    if len(starts) > 1:
        notes.append(f"{len(starts) - 1} gaps in the log: the solvers start again behind each from the run's own state")
    begin = time.perf_counter()
    check = _reference(plants, index, period_s, skipped, command, state, initial_state, limits, stimulus)
    reference_wall_s = time.perf_counter() - begin
    states = _state_matrix(state)
    begin = time.perf_counter()
    ida = _ida(
        plants[index], rtol, period_s, commands, scales, period_of_row, starts, initial_state, states, notes, progress
    )
    ida_wall_s = time.perf_counter() - begin
    run = np.ascontiguousarray(states[:, :QUANTITY_COUNT])
    reference = np.column_stack([check[f"reference_{name}"] for name in _NAMES])
    one_step = np.column_stack([check[f"one_step_{stem}_error{unit}"] for stem, unit in _STEMS])
    out = np.flatnonzero(check["flags"] & 1)
    previous = np.vstack((np.asarray(initial_state)[None, :], states[:-1]))
    step_size = np.abs(one_step[:, 2:4]).max(axis=1, initial=0.0)
    return AxisDae(
        axis=axis,
        tick=state["tick"].astype(np.int64),
        times_s=(state["tick"] + 1.0) * period_s,
        valve=command["valve_command"].copy(),
        run=run,
        reference=reference,
        ida=ida,
        one_step_error=one_step,
        check=check,
        figures=_figures(state["tick"], run, reference, ida[:, :QUANTITY_COUNT], one_step),
        places=places_in_range(engine_plant, previous, command["valve_command"].copy(), step_size),
        out_of_tolerance=len(out),
        first_out_tick=int(state["tick"][out[0]]) if len(out) else None,
        ida_wall_s=ida_wall_s,
        reference_wall_s=reference_wall_s,
        simulated_s=len(commands) * period_s,
        notes=tuple(notes),
    )


_BLOCK_TICKS = 20_000
_STEMS = (
    ("rod_position", "_m"),
    ("rod_velocity", "_mps"),
    ("chamber_1_pressure", "_pa"),
    ("chamber_2_pressure", "_pa"),
)
_NAMES = tuple(stem + unit for stem, unit in _STEMS)


def _rows(log: Run, axis: str, tick_limit: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """COMMAND, STATE and skipped counts of the ticks that all three topics hold."""
    command, state, tick = log.command[axis], log.state[axis], log.tick
    common = np.intersect1d(np.intersect1d(command["tick"], state["tick"]), tick["tick"])
    if tick_limit is not None:
        common = common[:tick_limit]
    rows = [one[np.searchsorted(one["tick"], common)] for one in (command, state, tick)]
    return rows[0], rows[1], rows[2]["skipped_count"].astype(np.int64)


def expand_inputs(command: np.ndarray, state: np.ndarray, skipped: np.ndarray, stimulus: np.ndarray):
    """Inputs of every grid period, also of skipped ones, under the assumptions of record.crosscheck.

    Returns (commands float64[p], load scales float64[p], last period of each logged tick int64[n],
    [(first row, first period, after a gap)] a segment).
    """
    count = skipped + 1
    number = state["tick"].astype(np.int64)
    gap = np.diff(number, prepend=number[:1] - count[:1]) != count
    if len(number):
        gap[0] = number[0] != skipped[0]
    count = np.where(gap, 0, count)  # what came before a gap is not known: the tick behind it only gives a start
    ends = np.cumsum(count)
    total = int(ends[-1]) if len(ends) else 0
    row = np.repeat(np.arange(len(count)), count)
    share = (np.arange(total) - (ends - count)[row] + 1) / count[row]
    valve, scale = command["valve_command"], state["load_scale"]
    before = np.maximum(row - 1, 0)
    ramping = ((len(stimulus) > 0) | (command["mode"] == status.MODE_STALE_RAMP))[row]
    commands = np.where(ramping, valve[before] + (valve[row] - valve[before]) * share, valve[row])
    if len(stimulus):
        last = len(stimulus) - 1
        own = stimulus[np.minimum(number, last)] == valve
        period = number[row] - (ends[row] - 1 - np.arange(total))
        known = own[row] & (own[before] | (row == 0))
        commands = np.where(known, stimulus[np.clip(period, 0, last)], commands)
    scales = scale[before] + (scale[row] - scale[before]) * share
    starts = [(int(at), int(ends[at]), True) for at in np.flatnonzero(gap)]
    if not len(gap) or not gap[0]:
        starts.insert(0, (0, 0, False))
    return np.clip(commands, -1.0, 1.0), scales, ends - 1, starts


def _reference(
    plants, index: int, period_s: float, skipped, command, state, initial_state, limits, stimulus
) -> np.ndarray:
    model = reference_model(plants, period_s)
    check = records.allocate(records.CHECK, len(state))
    walk = new_walk(initial_state, float(state["load_scale"][0]) if len(state) else 1.0)
    rows = (np.ascontiguousarray(skipped), np.ascontiguousarray(command), np.ascontiguousarray(state))
    for start, stop in blocks(len(state), _BLOCK_TICKS):
        part = (one[start:stop] for one in rows)
        check_periods(model, index, period_s, *part, walk, limits, 1, stimulus, check[start:stop])
    return check


def _ida(
    plant, rtol, period_s, commands, scales, period_of_row, starts, initial_state, states, notes, progress
) -> np.ndarray:
    """IDA's states at the logged ticks, float64[n, 10]; NaN from where it gave up to the next start."""
    result = np.full((len(states), STATE_SIZE), np.nan)
    bounds = [*starts[1:], (len(states), len(commands), True)]
    done_before = 0
    with IdaSolver(plant, rtol) as solver:
        for (row, period, after_gap), (row_end, period_end, _) in zip(starts, bounds, strict=True):
            start = states[row] if after_gap else np.asarray(initial_state, np.float64)
            solved = np.full((period_end - period, STATE_SIZE), np.nan)
            base = done_before
            done = solver.run(
                np.ascontiguousarray(commands[period:period_end]), np.ascontiguousarray(scales[period:period_end]), period_s, start, solved,
                lambda count, base=base: progress((base + count) / max(len(commands), 1)),
            )  # fmt: skip
            done_before += period_end - period
            first = row + 1 if after_gap else row
            if after_gap:
                result[row] = states[row]
            wanted = period_of_row[first:row_end] - period
            reached = wanted < done
            result[first:row_end][reached] = solved[wanted[reached]]
            if done < period_end - period:
                at = int(np.searchsorted(period_of_row, period + done))
                notes.append(f"IDA gave up {done * period_s:.3f} s after its start, at row {at} of {len(states)}")
    progress(1.0)
    return result


def _state_matrix(state: np.ndarray) -> np.ndarray:
    return np.column_stack([state[name] for name in records.STATE_FIELDS]).astype(np.float64)


def _figures(tick, run, reference, ida, one_step) -> list[ErrorFigures]:
    errors = dict(zip(COMPARISONS, (run - ida, reference - ida, run - reference, one_step), strict=True))
    return [
        _figure(tick, quantity, comparison, error[:, place], ida[:, place], reference[:, place], factor, unit)
        for quantity, (place, factor, unit) in QUANTITIES.items()
        for comparison, error in errors.items()
    ]


def _figure(tick, quantity, comparison, error, ida, reference, factor, unit) -> ErrorFigures:
    truth = ida if np.isfinite(ida).any() else reference
    finite = np.isfinite(error)
    size = np.abs(np.where(finite, error, 0.0))
    worst = int(np.argmax(size)) if len(size) else 0
    rms = float(np.sqrt(np.mean(size[finite] ** 2))) if finite.any() else float("nan")
    largest = float(size[worst]) if finite.any() else float("nan")
    spread = float(np.nanmax(truth) - np.nanmin(truth)) if np.isfinite(truth).any() else 0.0
    per_range = 1.0 / spread if spread > 0 else float("nan")
    return ErrorFigures(
        quantity=quantity,
        comparison=comparison,
        unit=unit,
        max=largest / factor,
        rms=rms / factor,
        max_normalised=largest * per_range,
        rms_normalised=rms * per_range,
        worst_tick=int(tick[worst]) if len(tick) else -1,
    )
