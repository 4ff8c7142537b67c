"""How wrong the plant of this run is: the first-principle model stepped from the commands the surrogate got.

Three errors per tick: of a shadow trajectory that runs free from the same start (what has accumulated), of one period from
the surrogate's own last state (what this period added), and the first one's mean over the last second of an open valve (what
stays when the short transients of spools without mass have gone; oil trapped by a shut valve only keeps the error of the
moment it was shut). Outside the loop, compiled, a batch of ticks at a time.

What a trajectory may be off by before it is a fault depends on the plant: coming off an end stop at full speed, or in the limit cycle of a
counterbalance valve, a difference far below every tolerance grows to the size of the motion within milliseconds, and two exact
solvers end apart. So a third trajectory runs beside the shadow, by the same model: the neighbour, whose valve opens by NEIGHBOUR_SHARE
less. How far it has come from the shadow is how far a difference of no account has grown, and the tolerances of the free run
are widened by a multiple of it (of its largest value, forgotten within a second). On an ordinary run that is a small
part of the tolerance. The one-step error starts from the surrogate's own state, where nothing has had time to grow, and is judged as it is.

Assumptions: the records are in order; `valve_command` and `load_scale` held for the tick's period. Of skipped periods only
the last inputs are logged: between the tick before and this one the load scale, and a command that was ramping to neutral,
are taken as linear; a command from the bus acts from the first skipped period on, as in the loop. The commands of a
stimulus are known; where the logged ones on both sides are not the stimulus' own (a valve fault), they are linear too.
Where ticks are missing from the ring the inputs are unknown: both trajectories restart from the surrogate's state (counted).
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hilrunner.base import state_layout, status
from hilrunner.base.compiled import entry, hot
from hilrunner.plant.model import PlantModel, assemble
from hilrunner.plant.step import advance_reference

FLAG_OUT_OF_TOLERANCE = 1 << 0
FLAG_RESTARTED = 1 << 1  # no errors at this tick: the trajectories start again from the surrogate's state

QUANTITIES = (
    "rod_position_m",
    "rod_velocity_mps",
    "chamber_1_pressure_pa",
    "chamber_2_pressure_pa",
)  # state places 0..3
QUANTITY_COUNT = len(QUANTITIES)

ERROR_KINDS = ("of the free run", "of one step", "sustained")
ROW_COUNT = len(ERROR_KINDS) * QUANTITY_COUNT
SUSTAINED_S = 1.0  # time constant of the sustained error's mean
NEIGHBOUR_SHARE = 1e-5  # of the valve's opening
SPREAD_S = 1.0  # time constant with which the neighbour's largest distance is forgotten
# How many times its distance a free run is allowed beyond its tolerance: networks whose flows are right to 1e-4 are not blamed for what
# the plant makes of it. A mean over a second does not grow like its worst moment.
SPREADS_ALLOWED = 10.0
SPREADS_ALLOWED_SUSTAINED = 1.0

# columns of the accumulator, one row an error: the four of the shadow, the four of one step, the four sustained
(SUM_MAX, SUM_MAX_TICK, SUM_SQUARES, SUM_COUNT) = range(4)

# places of the integers a walk carries from batch to batch
(WALK_STARTED, WALK_TICK, WALK_RESTART_COUNT, WALK_FAILED_TICK, WALK_FAILED_ROW) = range(5)


class Walk(NamedTuple):
    """What the check of one axis carries from batch to batch."""

    shadow: np.ndarray  # (10,) float64, base.state_layout: the free-running reference
    neighbour: np.ndarray  # (10,) float64: the same with its valve NEIGHBOUR_SHARE less open
    previous: np.ndarray  # (10,) float64: the surrogate's last logged state
    one_step: np.ndarray  # (10,) float64, scratch
    held: np.ndarray  # (2,) float64: valve command and load scale of the last tick
    number: np.ndarray  # (5,) int64: WALK_*; failed tick and row -1 while none
    accumulated: np.ndarray  # (ROW_COUNT, 4) float64: SUM_*
    sustained: np.ndarray  # (4,) float64: exponential mean of the shadow's errors
    spread: np.ndarray  # (4,) float64: how far the neighbour has been from the shadow of late
    spread_max: np.ndarray  # (4,) float64: the same over the whole run
    failed_error: np.ndarray  # (2,) float64: the error that was out first, and what was allowed


def new_walk(initial_state: np.ndarray, load_scale: float = 1.0) -> Walk:
    """The walk of an axis before its first tick; the start is the state before tick 0."""
    start = np.array(initial_state, np.float64)
    if start.shape != (state_layout.STATE_SIZE,):
        raise ValueError(f"initial state of shape {start.shape}, expected ({state_layout.STATE_SIZE},)")
    number = np.array([0, -1, 0, -1, -1], np.int64)
    return Walk(
        start.copy(),
        start.copy(),
        start.copy(),
        np.zeros(state_layout.STATE_SIZE),
        np.array([0.0, load_scale]),
        number,
        np.zeros((ROW_COUNT, 4)),
        np.zeros(QUANTITY_COUNT),
        np.zeros(QUANTITY_COUNT),
        np.zeros(QUANTITY_COUNT),
        np.zeros(2),
    )


@hot
def _logged_state(record, out):
    """Copy the ten state fields of a STATE record."""
    out[0] = record["rod_position_m"]
    out[1] = record["rod_velocity_mps"]
    out[2] = record["chamber_1_pressure_pa"]
    out[3] = record["chamber_2_pressure_pa"]
    out[4] = record["spool_1_position_m"]
    out[5] = record["spool_2_position_m"]
    out[6] = record["spool_1_velocity_mps"]
    out[7] = record["spool_2_velocity_mps"]
    out[8] = record["line_a_pressure_pa"]
    out[9] = record["line_b_pressure_pa"]


@hot
def _is_stimulus(stimulus, tick, valve_command):
    """Whether the logged command of a tick is what the stimulus says; before the first tick it says nothing."""
    return stimulus.shape[0] > 0 and (tick < 0 or stimulus[min(tick, stimulus.shape[0] - 1)] == valve_command)


@hot
def _advance_periods(
    model, axis, period_s, tick, count, held, valve_command, load_scale, ramping, stimulus, opening, state
):
    """`count` periods, the last of them `tick`, that end with the inputs given; see the assumptions above.

    `opening` is the factor on every valve command: 1, or the neighbour's.
    """
    known = count > 1 and _is_stimulus(stimulus, tick - count, held[0]) and _is_stimulus(stimulus, tick, valve_command)
    for k in range(1, count + 1):
        share = k / count
        scale = held[1] + (load_scale - held[1]) * share
        valve = valve_command
        if known:
            valve = stimulus[min(tick - count + k, stimulus.shape[0] - 1)]
        elif ramping or stimulus.shape[0] > 0:
            valve = held[0] + (valve_command - held[0]) * share
        advance_reference(model, axis, opening * min(max(valve, -1.0), 1.0), scale, period_s, state)


@hot
def _account(accumulated, row, tick, error):
    """One error into maximum, its tick, sum of squares and count; an error that is no number counts as infinite."""
    size = abs(error)
    if not math.isfinite(size):
        size = math.inf
    if accumulated[row, SUM_COUNT] == 0.0 or size > accumulated[row, SUM_MAX]:
        accumulated[row, SUM_MAX] = size
        accumulated[row, SUM_MAX_TICK] = tick
    accumulated[row, SUM_SQUARES] += size * size
    accumulated[row, SUM_COUNT] += 1.0
    return size


@hot
def _restart(walk, surrogate):
    """All trajectories from the surrogate's state."""
    for k in range(state_layout.STATE_SIZE):
        walk.shadow[k] = surrogate[k]
        walk.neighbour[k] = surrogate[k]
    walk.sustained[:] = 0.0
    walk.spread[:] = 0.0
    walk.number[WALK_RESTART_COUNT] += 1


@hot
def _store_errors(record, shadow, surrogate, one_step, with_one_step):
    """Fill the reference and error fields of a CHECK record; one-step errors are NaN where not computed."""
    record["reference_rod_position_m"] = shadow[0]
    record["reference_rod_velocity_mps"] = shadow[1]
    record["reference_chamber_1_pressure_pa"] = shadow[2]
    record["reference_chamber_2_pressure_pa"] = shadow[3]
    record["rod_position_error_m"] = surrogate[0] - shadow[0]
    record["rod_velocity_error_mps"] = surrogate[1] - shadow[1]
    record["chamber_1_pressure_error_pa"] = surrogate[2] - shadow[2]
    record["chamber_2_pressure_error_pa"] = surrogate[3] - shadow[3]
    record["one_step_rod_position_error_m"] = surrogate[0] - one_step[0] if with_one_step else math.nan
    record["one_step_rod_velocity_error_mps"] = surrogate[1] - one_step[1] if with_one_step else math.nan
    record["one_step_chamber_1_pressure_error_pa"] = surrogate[2] - one_step[2] if with_one_step else math.nan
    record["one_step_chamber_2_pressure_error_pa"] = surrogate[3] - one_step[3] if with_one_step else math.nan


@hot
def _measure_spread(walk, passed_s):
    """Move on how far the neighbour has been from the shadow of late."""
    kept = math.exp(-passed_s / SPREAD_S)
    for k in range(QUANTITY_COUNT):
        distance = abs(walk.neighbour[k] - walk.shadow[k])
        if math.isfinite(distance):  # a reference that is lost excuses nothing
            walk.spread[k] = max(walk.spread[k] * kept, distance)
            walk.spread_max[k] = max(walk.spread_max[k], walk.spread[k])


@hot
def _judge_one(walk, tick, row, error, allowed):
    """Account one error and compare it with what is allowed; True when it is out."""
    size = _account(walk.accumulated, row, tick, error)
    if not size > allowed:
        return False
    if walk.number[WALK_FAILED_TICK] < 0:
        walk.number[WALK_FAILED_TICK] = tick
        walk.number[WALK_FAILED_ROW] = row
        walk.failed_error[0] = error
        walk.failed_error[1] = allowed
    return True


@hot
def _judge(walk, tick, errors_of, surrogate, first_row, limits, spreads):
    """Account four errors and compare them with their limits, widened by `spreads` of the neighbour; True when one is out."""
    out = False
    for k in range(QUANTITY_COUNT):
        allowed = limits[first_row + k] + spreads * walk.spread[k]
        out = _judge_one(walk, tick, first_row + k, surrogate[k] - errors_of[k], allowed) or out
    return out


@hot
def _judge_sustained(walk, tick, surrogate, passed_s, limits):
    """Move the means on by the time passed and judge them; True when one is out."""
    weight = -math.expm1(-passed_s / SUSTAINED_S)
    out = False
    for k in range(QUANTITY_COUNT):
        error = surrogate[k] - walk.shadow[k]
        if math.isfinite(error):  # an error that is no number has failed already, and would stay in the mean for ever
            walk.sustained[k] += weight * (error - walk.sustained[k])
        row = 2 * QUANTITY_COUNT + k
        allowed = limits[row] + SPREADS_ALLOWED_SUSTAINED * walk.spread[k]
        out = _judge_one(walk, tick, row, walk.sustained[k], allowed) or out
    return out


@entry
def check_periods(model, axis, period_s, skipped, command, state, walk, limits, one_step_every, stimulus, check):
    """Step the reference through n logged ticks of one axis.

    Args:
        model: PlantModel, read; its parameters, loads and substeps of the reference engine.
        axis: index in the model.
        period_s: length of a period.
        skipped: (n,) int64, whole periods skipped just before each tick.
        command, state: (n,) COMMAND and STATE records of the axis, read.
        walk: Walk, read and written.
        limits: (ROW_COUNT,) float64, largest errors allowed (inf: not watched), rows as in Walk.accumulated.
        one_step_every: the one-step error is computed at ticks divisible by it.
        stimulus: (m,) float64, valve commands by tick in place of the bus, the last one held; NaN where they are not known.
            Empty: frames commanded.
        check: (n,) CHECK records, written; `lag_ns` is left to the caller.

    Returns:
        ticks out of tolerance in this batch.
    """
    surrogate = np.empty(state_layout.STATE_SIZE)
    out_count = 0
    for i in range(state.shape[0]):
        tick = np.int64(state[i]["tick"])
        _logged_state(state[i], surrogate)
        count = tick - walk.number[WALK_TICK]
        record = check[i]
        record["tick"] = tick
        record["flags"] = 0
        with_one_step = False
        if count != skipped[i] + 1 or count < 1:
            _restart(walk, surrogate)
            record["flags"] = FLAG_RESTARTED
        else:
            valve, scale = command[i]["valve_command"], state[i]["load_scale"]
            if walk.number[WALK_STARTED] == 0:
                walk.held[0], walk.held[1] = valve, scale
            ramping = command[i]["mode"] == status.MODE_STALE_RAMP
            _advance_periods(
                model, axis, period_s, tick, count, walk.held, valve, scale, ramping, stimulus, 1.0, walk.shadow
            )
            _advance_periods(
                model, axis, period_s, tick, count, walk.held, valve, scale, ramping, stimulus, 1.0 - NEIGHBOUR_SHARE,
                walk.neighbour,
            )  # fmt: skip
            _measure_spread(walk, count * period_s)
            out = _judge(walk, tick, walk.shadow, surrogate, 0, limits, SPREADS_ALLOWED)
            if valve != 0.0:  # else trapped oil would weigh one moment's error again and again
                out = _judge_sustained(walk, tick, surrogate, count * period_s, limits) or out
            with_one_step = tick % one_step_every == 0
            if with_one_step:
                for k in range(state_layout.STATE_SIZE):
                    walk.one_step[k] = walk.previous[k]
                _advance_periods(
                    model, axis, period_s, tick, count, walk.held, valve, scale, ramping, stimulus, 1.0,
                    walk.one_step,
                )  # fmt: skip
                out = _judge(walk, tick, walk.one_step, surrogate, QUANTITY_COUNT, limits, 0.0) or out
            if out:
                record["flags"] = FLAG_OUT_OF_TOLERANCE
                out_count += 1
        _store_errors(record, walk.shadow, surrogate, walk.one_step, with_one_step)
        if not math.isfinite(walk.shadow[0] + walk.shadow[1] + walk.shadow[2] + walk.shadow[3]):
            _restart(walk, surrogate)  # a lost reference would hide everything after it
        for k in range(state_layout.STATE_SIZE):
            walk.previous[k] = surrogate[k]
        walk.held[0], walk.held[1] = command[i]["valve_command"], state[i]["load_scale"]
        walk.number[WALK_TICK] = tick
        walk.number[WALK_STARTED] = 1
    return out_count


def reference_model(plants, period_s: float) -> PlantModel:
    """The first-principle model of every axis, whatever engine the plants were made for."""
    made = [replace(plant, engine=status.ENGINE_REFERENCE, networks=None) for plant in plants]
    return assemble(made, period_s)
