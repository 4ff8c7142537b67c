"""Every branch of the loop's timing arithmetic, on a simulated clock: the grid, misses, skips, limits, ends."""

import pytest

from hilrunner.base import status
from hilrunner.base.records import TICK_FLAG_FORCED_FAIL_SAFE, TICK_FLAG_MISS, TICK_FLAG_NEAR_MISS, TICK_FLAG_SKIPPED

START_NS = 1_000_000_000
PERIOD_NS = 1_000_000


def ticks(result: dict) -> list[int]:
    return [tick for tick, _, _ in result["ran"]]


def test_every_deadline_lies_on_the_grid(happened):
    for name, result in happened.items():
        for tick, deadline_ns in zip(ticks(result), result["deadlines"], strict=False):
            assert deadline_ns == START_NS + tick * PERIOD_NS, name


def test_on_time_ticks_wake_at_their_deadline(happened):
    result = happened["on_time"]
    assert ticks(result) == list(range(8))
    assert result["miss_count"] == 0 and result["skipped_count"] == 0
    assert all(0 <= wake - deadline <= 50 for wake, deadline in zip(result["wakes"], result["deadlines"], strict=True))
    assert result["reason"] == status.EXIT_DURATION


def test_a_little_late_costs_a_little(happened):
    result = happened["late_a_little"]
    assert ticks(result) == list(range(8)), "0.1 ms late must not lose a period"
    assert result["miss_ticks"] == [3]
    assert 100_000 <= result["miss_lateness"][0] <= 101_000
    late = [wake - deadline for wake, deadline in zip(result["wakes"], result["deadlines"], strict=True)]
    assert 100_000 <= late[4] <= 102_000, "the next tick starts at once"
    assert late[5] <= 50, "and the one after is back on the grid"


def test_skip_loses_whole_periods_and_the_plant_advances_through_them(happened):
    result = happened["stall_skip"]
    assert ticks(result) == list(range(10)), "plant time never falls behind the grid"
    assert result["skipped_count"] == 2
    skipped = [flags & TICK_FLAG_SKIPPED != 0 for flags in result["tick_flags"]]
    assert [tick for tick, value in enumerate(skipped) if value] == [4, 5]


def test_skipped_periods_are_late_samples(happened):
    result = happened["stall_skip"]
    assert result["late_samples"] == 10, "8 ticks ran, 2 were skipped: 10 samples"
    assert 2_400_000 <= result["late_max"] <= 2_402_000, "the first skipped tick waited longest"


def test_catch_up_runs_every_period_late(happened):
    result = happened["stall_catch_up"]
    assert ticks(result) == list(range(10))
    assert result["skipped_count"] == 0
    assert all(advanced == 1 for _, advanced, _ in result["ran"])
    assert result["miss_ticks"] == [3, 4, 5]
    assert result["wakes"][8] - result["deadlines"][8] <= 50


def test_stop_ends_at_the_first_miss(happened):
    result = happened["stall_stop"]
    assert ticks(result) == [0, 1, 2, 3]
    assert result["reason"] == status.EXIT_DEADLINE


def test_a_late_wake_within_the_period_is_no_miss(happened):
    result = happened["late_wake"]
    assert result["miss_count"] == 0
    assert 250_000 <= result["late_max"] <= 250_100


def test_warm_up_is_run_and_logged_but_not_counted(happened):
    result = happened["warm_up"]
    assert result["miss_count"] == 0 and result["miss_ticks"] == []
    assert len(result["deadlines"]) == 8
    assert result["late_samples"] == 5


def test_total_misses_stop_and_warn(happened):
    stopped = happened["total_stop"]
    assert stopped["reason"] == status.EXIT_DEADLINE and ticks(stopped)[-1] == 4
    warned = happened["total_warn"]
    assert warned["reason"] == status.EXIT_DURATION and warned["warned_count"] == 2


def test_consecutive_means_consecutive(happened):
    assert happened["consecutive_spread"]["reason"] == status.EXIT_DURATION
    assert happened["consecutive_stop"]["reason"] == status.EXIT_DEADLINE


def test_lateness_beyond_the_limit_latches_the_fail_safe(happened):
    result = happened["lateness_fail_safe"]
    assert result["mode"] == status.MODE_FAIL_SAFE
    flagged = [index for index, flags in enumerate(result["tick_flags"]) if flags & TICK_FLAG_FORCED_FAIL_SAFE]
    assert len(flagged) == 1 and ticks(result)[flagged[0]] == 4, "told with the tick it first acts on"
    assert happened["lateness_below"]["reason"] == status.EXIT_DURATION


def test_ticks_around_a_miss_are_marked(happened):
    flags = happened["late_a_little"]["tick_flags"]
    assert flags[3] == TICK_FLAG_MISS | TICK_FLAG_NEAR_MISS
    assert flags[4] & TICK_FLAG_NEAR_MISS and not flags[2]


@pytest.mark.parametrize(("name", "errno"), [("receive_lost", 100), ("send_lost", 19)])
def test_a_bus_that_is_gone_ends_the_run(happened, name, errno):
    assert happened[name]["reason"] == status.EXIT_CAN_LOST
    assert happened[name]["bus_errno"] == errno


def test_a_full_transmit_queue_is_counted_not_fatal(happened):
    assert happened["send_full"]["reason"] == status.EXIT_DURATION
    assert happened["send_full"]["frames_unsent"] == 2


def test_a_state_that_is_not_finite_ends_the_run_at_once(happened):
    result = happened["not_finite"]
    assert result["reason"] == status.EXIT_NOT_FINITE and ticks(result)[-1] == 4
    assert len(result["deadlines"]) == 5, "the tick that failed is in the log"


def test_other_ends(happened):
    assert happened["stop_request"]["reason"] == status.EXIT_SIGNAL and ticks(happened["stop_request"])[-1] == 5
    assert happened["stimulus_end"]["reason"] == status.EXIT_STIMULUS_END and len(happened["stimulus_end"]["ran"]) == 7
    assert happened["no_ticks"]["ran"] == []


def on_time(result: dict) -> bool:
    return all(0 <= wake - deadline <= 60 for wake, deadline in zip(result["wakes"], result["deadlines"], strict=True))


def rehearsed(result: dict) -> list[int]:
    return [tick for tick, _, _ in result["rehearsed"]]


def test_a_rehearsal_is_over_before_an_ordinary_wake_up_would_be_late(happened):
    result = happened["rehearsed_asleep"]
    assert rehearsed(result) == list(range(1, 12)), "the first tick tells how long one takes"
    assert all(110_000 < begin_ns < 115_000 for _, begin_ns, _ in result["rehearsed"])
    assert all(left_ns > 60_000 for _, _, left_ns in result["rehearsed"]) and on_time(result)


def test_a_late_wake_up_leaves_the_rehearsal_out(happened):
    assert 4 not in rehearsed(happened["late_wake"]) and 5 in rehearsed(happened["late_wake"])


def test_no_rehearsal_where_the_tick_takes_too_much_of_the_period(happened):
    assert happened["rehearsal_not_worth_it"]["rehearsed"] == []
    assert happened["rehearsal_off"]["rehearsed"] == []


def test_with_a_spin_tail_a_rehearsal_ends_just_before_the_deadline(happened):
    result = happened["rehearsed"]
    assert rehearsed(result) == list(range(1, 12))
    assert all(5_000 < left_ns < 15_000 for _, _, left_ns in result["rehearsed"]) and on_time(result)


def test_a_rehearsal_that_was_held_up_is_not_the_last(happened):
    result = happened["rehearsal_held_up"]
    assert rehearsed(result) == list(range(1, 12))
    assert result["rehearsed"][3][2] < 0, "this one ran past its deadline"
    late = [wake - deadline for wake, deadline in zip(result["wakes"], result["deadlines"], strict=True)]
    assert [tick for tick, value in enumerate(late) if value > 60] == [4] and result["miss_count"] == 0


def test_rehearsals_longer_than_the_tick_are_learnt(happened):
    result = happened["rehearsal_longer_than_the_tick"]
    late = [wake - deadline for wake, deadline in zip(result["wakes"], result["deadlines"], strict=True)]
    assert [tick for tick, value in enumerate(late) if value > 60] == [1], "once, and never again"


def test_no_rehearsal_where_the_spin_tail_is_too_short(happened):
    result = happened["rehearsal_too_long"]
    assert rehearsed(result) == [] and on_time(result)


def test_no_rehearsal_when_woken_too_late_for_it(happened):
    result = happened["rehearsal_woken_late"]
    assert rehearsed(result) == [1, 2, 3, 4, 5, 7, 8, 9, 10, 11] and on_time(result)


def test_a_full_ring_drops_whole_ticks_and_counts_them(happened):
    result = happened["ring_full"]
    assert len(result["ran"]) == 300
    assert len(result["deadlines"]) + result["dropped"] == 300 and result["dropped"] > 0
