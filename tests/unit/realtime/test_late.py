"""After a stall every frame belongs to the period in which it came, whatever the host, the wall clock or the end of the run do meanwhile.

The scenarios run on a simulated clock (`loop_scenarios.py`): a firmware sends a command every 5 ms and never stops, the host
stands still for 150 ms.
"""

import pytest

from hilrunner.base import status
from hilrunner.base.records import TICK_FLAG_MISS, TICK_FLAG_SKIPPED
from hilrunner.realtime.late import arrival_ns

START_NS = 1_000_000_000
PERIOD_NS = 1_000_000
WALL_NS = 1_700_000_000_000_000_000
STALL_NS = 150_000_000
FIRMWARE_PERIODS = 5
SKIPPING = ("asleep", "at_work", "at_the_start", "on_the_way_to_its_frames", "over_the_end", "over_the_end_at_work",
            "asleep_and_set_forward", "asleep_and_set_back")  # fmt: skip
CATCHING_UP = ("asleep_catch_up", "at_work_catch_up", "over_the_end_catch_up")


def ticks(result: dict) -> list[int]:
    return [tick for tick, _, _ in result["ran"]]


def period_of(sent_ns: int) -> int:
    """The first period whose deadline is not before the frame; a frame that came before the run belongs to the first."""
    return max(-((START_NS - sent_ns) // PERIOD_NS), 0)


@pytest.mark.parametrize("name", SKIPPING + CATCHING_UP)
def test_every_frame_belongs_to_the_period_in_which_it_came(happened, name):
    result = happened[name]
    sent = [START_NS - 300_000 + k * FIRMWARE_PERIODS * PERIOD_NS for k in range(len(result["frame_ticks"]))]
    assert len(sent) == -(-len(result["rows"]) // FIRMWARE_PERIODS)
    assert result["frame_ticks"] == [period_of(time_ns) for time_ns in sent]
    assert set(result["frame_statuses"]) == {status.FRAME_VALID}


@pytest.mark.parametrize("name", SKIPPING + CATCHING_UP)
def test_a_firmware_that_never_stopped_is_not_blamed(happened, name):
    result = happened[name]
    assert max(result["ages"]) == (FIRMWARE_PERIODS - 1) * PERIOD_NS, "no command was ever older than a healthy one"
    assert result["mode"] == status.MODE_ACTIVE


@pytest.mark.parametrize("name", (*SKIPPING, "over_the_end_of_a_stimulus", "in_the_last_tick"))
def test_the_log_holds_a_row_of_every_period(happened, name):
    result = happened[name]
    assert result["rows"] == list(range(len(result["rows"]))) and not any(result["skipped_of_rows"])
    skipped = [flags & TICK_FLAG_SKIPPED != 0 for flags in result["tick_flags"]]
    assert sum(skipped) == result["skipped_count"]
    assert all(periods == 1 for _, periods, _ in result["ran"])
    assert sum(result["frames_of_rows"]) == len(result["frame_ticks"])


@pytest.mark.parametrize(
    ("name", "first", "ticks_late"), [("asleep", 20, 150), ("at_work", 21, 149), ("at_the_start", 0, 150)]
)
def test_the_skipped_periods_are_those_of_the_stall(happened, name, first, ticks_late):
    flags = happened[name]["tick_flags"]
    skipped = [tick for tick, value in enumerate(flags) if value & TICK_FLAG_SKIPPED]
    assert skipped == list(range(first, first + ticks_late))
    assert happened[name]["reason"] == status.EXIT_DURATION and len(flags) == 300


@pytest.mark.parametrize("name", ["asleep", "at_work", "at_the_start", "on_the_way_to_its_frames"])
def test_a_stall_is_one_miss_and_its_lateness_is_judged(happened, name):
    result = happened[name]
    late = [value for value in result["miss_lateness"] if value > 0]
    assert len(late) == result["miss_count"] == 1 and STALL_NS - PERIOD_NS <= late[0] < STALL_NS
    assert sum(flags & TICK_FLAG_MISS for flags in result["tick_flags"]) == 1
    assert result["late_samples"] == 300 and STALL_NS - PERIOD_NS <= result["late_max"] <= STALL_NS + 100
    assert happened["lateness_of_a_stall"]["reason"] == status.EXIT_DEADLINE


@pytest.mark.parametrize("name", ["over_the_end", "over_the_end_at_work", "in_the_last_tick", "over_the_end_catch_up"])
def test_a_stall_over_the_planned_end_loses_no_period(happened, name):
    result = happened[name]
    assert result["reason"] == status.EXIT_DURATION
    assert ticks(result) == list(range(120)), "the plant went through all of them"
    assert len(result["rows"]) == 120 and result["stalls"][0] >= 1


def test_frames_that_came_after_the_planned_end_belong_to_no_period(happened):
    for name in ("over_the_end", "over_the_end_at_work", "in_the_last_tick", "over_the_end_catch_up"):
        assert max(happened[name]["frame_ticks"]) <= 119, name
    assert len(happened["in_the_last_tick"]["frame_ticks"]) == 24


def test_a_stimulus_is_played_to_its_end_through_a_stall(happened):
    result = happened["over_the_end_of_a_stimulus"]
    assert result["reason"] == status.EXIT_STIMULUS_END and ticks(result) == list(range(60))


def test_frames_without_stamps_hold_from_the_first_skipped_period_on(happened):
    result = happened["asleep_unstamped"]
    assert dict((tick, periods) for tick, periods, _ in result["ran"])[170] == 151
    assert result["skipped_count"] == 150 and result["mode"] == status.MODE_ACTIVE
    assert result["skipped_of_rows"][20] == 150 and result["rows"][20] == 170


def test_more_frames_than_the_inbox_holds_all_find_their_period(happened):
    result = happened["more_frames_than_the_inbox"]
    assert max(result["frames_of_rows"]) <= 20 and max(result["ages"]) == 0
    assert len(result["frame_ticks"]) > 2000 and result["frame_ticks"] == sorted(result["frame_ticks"])


@pytest.mark.parametrize("name", ["set_forward", "set_back", "asleep_and_set_forward", "asleep_and_set_back"])
def test_a_clock_that_is_set_makes_no_response_of_an_hour(happened, name):
    assert 0 < happened[name]["response_max"] < 2 * PERIOD_NS
    assert happened[name]["responses"] >= 30


def test_periods_that_were_skipped_are_computed_before_a_stop_is_heeded(happened):
    result = happened["stop_in_a_stall"]
    assert result["reason"] == status.EXIT_SIGNAL and ticks(result) == list(range(171))


def test_a_stall_is_counted_and_acts_by_the_profile(happened):
    for name in ("asleep", "stall_warn"):
        count, longest_ns, first, last_ns = happened[name]["stalls"]
        assert (count, first) == (1, 171) and longest_ns == last_ns == STALL_NS
        assert happened[name]["reason"] == status.EXIT_DURATION
    assert happened["stall_ends_the_run"]["reason"] == status.EXIT_STALLED
    assert ticks(happened["stall_ends_the_run"])[-1] == 170
    assert happened["stall_allowed"]["stalls"][:2] == [0, STALL_NS]
    assert happened["on_time"]["stalls"][0] == 0


@pytest.mark.parametrize("set_by_ns", [3_600_000_000_000, -3_600_000_000_000, 700_000_000])
def test_a_stamp_is_converted_by_the_clock_of_its_time(set_by_ns):
    """The wall clock is set at 500 ms of a stall of a second; what came before keeps its place."""
    after = WALL_NS + set_by_ns
    came_ns = 0
    for time_ns in range(0, 1_000_000_000, 10_000_000):
        stamp = time_ns + (after if time_ns >= 500_000_000 else WALL_NS)
        came_ns = arrival_ns(stamp, WALL_NS, after, came_ns, 1_000_000_000)
        assert came_ns == time_ns


def test_a_stamp_from_nowhere_keeps_its_order():
    assert arrival_ns(WALL_NS - 10**15, WALL_NS, WALL_NS, 500, 900) == 500
    assert arrival_ns(WALL_NS + 10**15, WALL_NS, WALL_NS, 500, 900) == 900
