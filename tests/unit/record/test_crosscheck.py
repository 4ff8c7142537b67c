"""The check's arithmetic: what it calls an error, where it restarts, what it does with gaps."""

import math

import check_plant
import numpy as np
import pytest

from hilrunner.base import records, status
from hilrunner.record import crosscheck

COUNT = 60
TICKS = np.arange(COUNT)
COMMANDS = 0.6 * np.sin(TICKS * 0.05)
SCALES = 1.0 + 0.1 * np.cos(TICKS * 0.03)
NO_LIMITS = np.full(crosscheck.ROW_COUNT, np.inf)
ERROR_FIELDS = [name for name in records.CHECK.names if "_error_" in name]
FREE, ONE_STEP = ERROR_FIELDS[:4], ERROR_FIELDS[4:]


@pytest.fixture(scope="module")
def bench():
    axis = check_plant.lift_axis()
    start = check_plant.start_state(axis)
    return axis, crosscheck.reference_model([axis], check_plant.PERIOD_S), start


@pytest.fixture(scope="module")
def states(bench):
    axis, _, start = bench
    return check_plant.run_reference(axis, COMMANDS, SCALES, start)


def check(
    bench,
    command,
    state,
    skipped=None,
    limits=NO_LIMITS,
    one_step_every=1,
    batches=(10**9,),
    walk=None,
    stimulus=(),
):
    _, model, start = bench
    walk = walk or crosscheck.new_walk(start)
    out = records.allocate(records.CHECK, len(state))
    skipped = np.zeros(len(state), np.int64) if skipped is None else np.asarray(skipped, np.int64)
    first = 0
    for size in batches:
        part = slice(first, first + size)
        crosscheck.check_periods(
            model, 0, check_plant.PERIOD_S, skipped[part], command[part], state[part], walk, limits, one_step_every,
            np.array(stimulus, float),
            out[part],
        )  # fmt: skip
        first += size
    return out, walk


def test_the_reference_against_itself_is_exact(bench, states):
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, states)
    out, walk = check(bench, command, state)
    assert (out["tick"] == TICKS).all() and (out["flags"] == 0).all()
    for name in ERROR_FIELDS:
        assert (out[name] == 0.0).all(), name
    assert (out["reference_chamber_1_pressure_pa"] == states[:, 2]).all()
    every_tick, open_valve = slice(0, 2 * crosscheck.QUANTITY_COUNT), slice(2 * crosscheck.QUANTITY_COUNT, None)
    assert (walk.accumulated[every_tick, crosscheck.SUM_COUNT] == COUNT).all()
    assert (walk.accumulated[open_valve, crosscheck.SUM_COUNT] == np.count_nonzero(COMMANDS)).all()


def test_a_disturbed_tick_is_an_error_of_that_step_and_of_the_free_run(bench, states):
    disturbed = states.copy()
    disturbed[20, 2] += 1000.0
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, disturbed)
    out, walk = check(bench, command, state)
    free, one_step = out["chamber_1_pressure_error_pa"], out["one_step_chamber_1_pressure_error_pa"]
    assert free[20] == pytest.approx(1000.0, rel=1e-9) and one_step[20] == pytest.approx(1000.0, rel=1e-9)
    assert (free[:20] == 0).all() and (free[21:] == 0).all()  # the surrogate's own trajectory is not the shadow's
    assert one_step[21] != 0.0  # stepped from the disturbed state
    assert (one_step[22:] == 0).all()
    row = walk.accumulated[2]
    assert row[crosscheck.SUM_MAX] == pytest.approx(1000.0) and row[crosscheck.SUM_MAX_TICK] == 20
    assert row[crosscheck.SUM_SQUARES] == pytest.approx(1e6)


@pytest.mark.parametrize("batches", [(1,) * COUNT, (7, 0, 13, 40), (59, 1)])
def test_batches_change_nothing(bench, states, batches):
    noisy = states * (1 + 1e-6 * np.sin(np.arange(states.size)).reshape(states.shape))
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, noisy)
    whole, _ = check(bench, command, state)
    parts, _ = check(bench, command, state, batches=batches)
    assert whole.tobytes() == parts.tobytes()


def test_skipped_periods_are_stepped_with_the_inputs_of_the_tick(bench, states):
    """As in the loop: a command that arrived acts from the first skipped period on; the load scale is taken as linear."""
    axis, _, start = bench
    commands, scales = COMMANDS.copy(), SCALES.copy()
    commands[10:15] = commands[14]
    scales[10:14] = scales[9] + (scales[14] - scales[9]) * np.arange(1, 5) / 5
    truth = check_plant.run_reference(axis, commands, scales, start)
    kept = np.delete(TICKS, [10, 11, 12, 13])
    skipped = np.where(kept == 14, 4, 0)
    command, state = check_plant.as_records(kept, commands[kept], scales[kept], truth[kept])
    out, walk = check(bench, command, state, skipped)
    assert walk.number[crosscheck.WALK_RESTART_COUNT] == 0
    for name in ERROR_FIELDS:
        assert abs(out[name]).max() < 1e-6, name  # the scale of the gap is rounded differently by an ulp
    assert (out["chamber_1_pressure_error_pa"][kept < 14] == 0).all()


def test_a_command_that_ramps_to_neutral_ramps_in_skipped_periods_too(bench, states):
    axis, _, start = bench
    commands = COMMANDS.copy()
    commands[30:34] = [0.75, 0.5, 0.25, 0.0]
    commands[29] = 1.0
    ones = np.ones(COUNT)
    truth = check_plant.run_reference(axis, commands, ones, start)
    kept = np.delete(TICKS, [30, 31, 32])
    command, state = check_plant.as_records(kept, commands[kept], ones[kept], truth[kept])
    command["mode"][kept == 33] = status.MODE_STALE_RAMP
    out, _ = check(bench, command, state, np.where(kept == 33, 3, 0))
    assert abs(out["one_step_chamber_1_pressure_error_pa"]).max() < 1e-6
    command["mode"] = status.MODE_ACTIVE
    unknown, _ = check(bench, command, state, np.where(kept == 33, 3, 0), stimulus=[math.nan])
    assert unknown.tobytes() == out.tobytes()
    held, _ = check(bench, command, state, np.where(kept == 33, 3, 0))
    assert abs(held["one_step_chamber_1_pressure_error_pa"]).max() > 100.0


def test_a_stimulus_is_known_in_skipped_periods_unless_a_valve_fault_acts(bench, states):
    axis, _, start = bench
    commands = COMMANDS.copy()
    commands[29:34] = [0.0, 0.9, 0.1, 0.6, 0.2]  # nothing like a straight line
    ones = np.ones(COUNT)
    truth = check_plant.run_reference(axis, commands, ones, start)
    kept = np.delete(TICKS, [30, 31, 32])
    command, state = check_plant.as_records(kept, commands[kept], ones[kept], truth[kept])
    skipped = np.where(kept == 33, 3, 0)
    out, _ = check(bench, command, state, skipped, stimulus=commands)
    assert abs(out["one_step_chamber_1_pressure_error_pa"]).max() < 1e-6
    faulty = commands.copy()
    faulty[33] += 0.1  # what the log says is not the stimulus: a fault stood between
    linear, _ = check(bench, command, state, skipped, stimulus=faulty)
    unknown, _ = check(bench, command, state, skipped, stimulus=[math.nan])
    assert linear.tobytes() == unknown.tobytes()
    assert abs(linear["one_step_chamber_1_pressure_error_pa"]).max() > 100.0


def test_missing_ticks_restart_the_check_and_are_marked(bench, states):
    kept = np.delete(TICKS, np.arange(30, 40))
    command, state = check_plant.as_records(kept, COMMANDS[kept], SCALES[kept], states[kept])
    out, walk = check(bench, command, state)  # nobody skipped: the ring dropped
    marked = out["tick"][out["flags"] == crosscheck.FLAG_RESTARTED]
    assert marked.tolist() == [40]
    assert walk.number[crosscheck.WALK_RESTART_COUNT] == 1
    assert np.isnan(out["one_step_rod_position_error_m"][kept == 40]).all()
    for name in FREE:
        assert (out[name] == 0).all(), name
    assert walk.accumulated[0, crosscheck.SUM_COUNT] == len(kept) - 1


def test_a_first_tick_that_is_not_tick_0_restarts(bench, states):
    command, state = check_plant.as_records(TICKS[5:], COMMANDS[5:], SCALES[5:], states[5:])
    out, walk = check(bench, command, state)
    assert out["flags"][0] == crosscheck.FLAG_RESTARTED and (out["flags"][1:] == 0).all()


@pytest.mark.parametrize("row, name", list(enumerate(ERROR_FIELDS)))
def test_each_error_has_a_limit_of_its_own(bench, states, row, name):
    place = row % 4
    disturbed = states.copy()
    disturbed[25:, place] += [1e-5, 1e-4, 3000.0, 3000.0][place] * np.arange(COUNT - 25)
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, disturbed)
    free, _ = check(bench, command, state)
    size = abs(free[name])
    limits = NO_LIMITS.copy()
    limits[row] = np.sort(size)[-6]  # five ticks are above
    out, walk = check(bench, command, state, limits=limits)
    assert (out["flags"] == np.where(size > limits[row], crosscheck.FLAG_OUT_OF_TOLERANCE, 0)).all()
    assert (out["flags"] != 0).sum() == 5
    assert walk.number[crosscheck.WALK_FAILED_ROW] == row
    assert walk.number[crosscheck.WALK_FAILED_TICK] == out["tick"][np.argmax(out["flags"] != 0)]


@pytest.mark.parametrize("gaps", [(), (20, 21, 22, 40)])
def test_the_sustained_error_is_the_mean_of_the_last_second(bench, states, gaps):
    """A first-order lag, written the other way round; skipped periods count as the time they took, a shut valve not at all."""
    kept = np.array([tick for tick in TICKS if tick not in gaps])
    disturbed = states.copy()
    disturbed[:, 3] += 4000.0 * np.sin(0.7 * TICKS) + 1000.0
    skipped = np.diff(kept, prepend=-1) - 1
    commands = np.where((kept > 50) & (kept < 55), 0.0, COMMANDS[kept])
    command, state = check_plant.as_records(kept, commands, SCALES[kept], disturbed[kept])
    out, walk = check(bench, command, state, skipped=skipped)
    mean, largest = 0.0, 0.0
    for error, periods, valve in zip(out["chamber_2_pressure_error_pa"], skipped + 1, commands, strict=True):
        if valve == 0.0:
            continue
        mean = error + (mean - error) * np.exp(-periods * check_plant.PERIOD_S / crosscheck.SUSTAINED_S)
        largest = max(largest, abs(mean))
    assert walk.sustained[3] == pytest.approx(mean, rel=1e-9)
    assert walk.accumulated[11, crosscheck.SUM_MAX] == pytest.approx(largest, rel=1e-9)


def test_a_short_transient_passes_where_a_lasting_error_fails(bench, states):
    """The same size: 20 ms of it stay below the sustained limit, all of it does not; the first to be out is told."""
    limits = NO_LIMITS.copy()
    limits[10] = 5000.0 * (1 - np.exp(-30 * check_plant.PERIOD_S / crosscheck.SUSTAINED_S))
    for lasts, fails in ((20, False), (COUNT - 10, True)):
        disturbed = states.copy()
        disturbed[10 : 10 + lasts, 2] += 5000.0
        command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, disturbed)
        out, walk = check(bench, command, state, limits=limits)
        assert bool(out["flags"].any()) is fails
    assert walk.number[crosscheck.WALK_FAILED_ROW] == 10
    assert walk.number[crosscheck.WALK_FAILED_TICK] == 10 + 30
    assert walk.failed_error[0] == pytest.approx(limits[10], rel=0.05)


def test_the_free_run_is_allowed_what_its_neighbour_does_and_one_step_is_not(bench, states):
    """The neighbour is the reference with its valve a little less open: here it is run by hand."""
    axis, _, start = bench
    beside = check_plant.run_reference(axis, COMMANDS * (1.0 - crosscheck.NEIGHBOUR_SHARE), SCALES, start)
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, states)
    _, walk = check(bench, command, state)
    distance = np.abs(beside - states)[:, :4]
    fading = np.exp(-check_plant.PERIOD_S / crosscheck.SPREAD_S)
    spread = np.zeros_like(distance)
    for tick in TICKS:
        spread[tick] = np.maximum(distance[tick], spread[tick - 1] * fading if tick else 0.0)
    np.testing.assert_allclose(walk.spread, spread[-1], rtol=1e-9)
    np.testing.assert_allclose(walk.spread_max, spread.max(axis=0), rtol=1e-9)
    assert 0.0 < spread[-1, 2] < 100.0, "a part of the tolerance that is no part of it"
    disturbed, tolerance_pa = states.copy(), 100.0
    for spreads, is_out in ((0.9 * crosscheck.SPREADS_ALLOWED, False), (1.1 * crosscheck.SPREADS_ALLOWED, True)):
        disturbed[-1, 2] = states[-1, 2] + tolerance_pa + spreads * spread[-1, 2]
        command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, disturbed)
        for row, fails in ((2, is_out), (6, True)):
            limits = NO_LIMITS.copy()
            limits[row] = tolerance_pa
            out, walk = check(bench, command, state, limits=limits)
            assert bool(out["flags"][-1]) is fails and not out["flags"][:-1].any()
        if is_out:
            assert walk.failed_error[0] > walk.failed_error[1] == pytest.approx(tolerance_pa)


def test_with_the_valve_shut_the_neighbour_is_the_reference(bench):
    axis, _, start = bench
    still = np.zeros(COUNT)
    command, state = check_plant.as_records(TICKS, still, SCALES, check_plant.run_reference(axis, still, SCALES, start))
    _, walk = check(bench, command, state)
    assert not walk.spread_max.any()


def test_one_step_errors_at_every_nth_tick_only(bench, states):
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, states)
    out, walk = check(bench, command, state, one_step_every=8)
    computed = ~np.isnan(out["one_step_chamber_1_pressure_error_pa"])
    assert out["tick"][computed].tolist() == list(range(0, COUNT, 8))
    assert walk.accumulated[4, crosscheck.SUM_COUNT] == computed.sum()
    assert walk.accumulated[0, crosscheck.SUM_COUNT] == COUNT


def test_a_surrogate_that_leaves_the_numbers_is_out_of_every_tolerance(bench, states):
    broken = states.copy()
    broken[40:, 2] = np.nan
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, broken)
    out, walk = check(bench, command, state, limits=np.full(crosscheck.ROW_COUNT, 1e9))
    assert (out["flags"][:40] == 0).all() and (out["flags"][40:] != 0).all()
    assert walk.accumulated[2, crosscheck.SUM_MAX] == np.inf
    assert walk.number[crosscheck.WALK_FAILED_TICK] == 40


def test_a_lost_reference_fails_once_and_starts_again(bench, states):
    walk = crosscheck.new_walk(np.full(10, np.nan))
    command, state = check_plant.as_records(TICKS, COMMANDS, SCALES, states)
    out, walk = check(bench, command, state, limits=np.full(crosscheck.ROW_COUNT, 1e9), walk=walk)
    assert out["flags"][0] == crosscheck.FLAG_OUT_OF_TOLERANCE
    assert (out["flags"][1:] == 0).all()
    assert (out["chamber_1_pressure_error_pa"][1:] == 0).all()


def test_the_start_has_ten_places():
    with pytest.raises(ValueError, match="expected"):
        crosscheck.new_walk(np.zeros(8))
