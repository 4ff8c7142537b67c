"""Percentiles are exact, skipped periods are late samples, every miss has its cause, what was lost is counted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base import histogram_scale, records, status
from hilrunner.evidence import latency
from hilrunner.evidence.facts import read_facts
from hilrunner.evidence.reader import read_run
from hilrunner.realtime.histogram import record_corrected
from tests.tools import synthetic_run


def measured(path, responses=()):
    run = read_run(path)
    return latency.measure_latency(run, read_facts(run), np.array(responses, np.int64)), run


@settings(max_examples=80, deadline=None)
@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=400))
def test_percentiles_are_samples_that_so_many_do_not_exceed(values):
    one = latency.distribution("step", np.array(values), "ticks")
    ordered = sorted(values)
    assert (one.values_ns["min"], one.values_ns["max"], one.count) == (ordered[0], ordered[-1], len(values))
    for name, ratio in histogram_scale.PERCENTILE_RATIOS.items():
        value = one.values_ns[name]
        assert sum(v <= value for v in values) >= ratio * len(values) * (1 - 1e-9)
        below = [v for v in values if v < value]
        assert len(below) < ratio * len(values)
    row, extreme = histogram_scale.from_values(np.array(values))
    assert np.array_equal(one.row, row)
    assert np.array_equal(one.extreme, extreme)


def test_skipped_periods_count_as_the_loop_counts_them(tmp_path):
    path = synthetic_run.write_run(tmp_path / "run.mcap", 5000, stall_every=1000)
    result, run = measured(path)
    row, extreme = histogram_scale.empty(1)
    for tick in run.tick:
        lateness = int(tick["wake_mono_ns"] - tick["deadline_mono_ns"])
        skipped = int(tick["skipped_count"])
        value = lateness + skipped * synthetic_run.PERIOD_NS
        record_corrected(row, extreme, 0, value, skipped, synthetic_run.PERIOD_NS)
    wake = result.distributions["wake_lateness"]
    assert result.skipped_count == 8
    assert wake.count == len(run.tick) + 8
    assert np.array_equal(wake.extreme, extreme[0])
    assert np.array_equal(wake.row, row[0])
    assert wake.values_ns["max"] == 2 * synthetic_run.PERIOD_NS + 200_000


def test_every_miss_is_told_with_its_cause(tmp_path):
    path = synthetic_run.write_run(tmp_path / "run.mcap", 5000, stall_every=1000)
    result, run = measured(path)
    assert result.miss_count == len(run.miss) == 5
    assert sum(result.causes.values()) == 5
    assert set(result.causes) == {"preempted by another task", "plant step"}
    worst = result.misses[0]
    assert worst.lateness_ns == run.miss["lateness_ns"].max()
    assert worst.detail == "1 involuntary switches"
    assert [m.lateness_ns for m in result.misses] == sorted((m.lateness_ns for m in result.misses), reverse=True)


def test_a_late_tick_without_a_row_is_counted_all_the_same(tmp_path):
    def drop_misses(block):
        block["miss"] = block["miss"][:1]

    result, _ = measured(synthetic_run.write_run(tmp_path / "run.mcap", 5000, stall_every=1000, edit=drop_misses))
    assert result.miss_count == 5
    assert result.causes["not explained in the log"] == 4


def test_ticks_that_never_reached_the_log_are_lost_and_not_late(tmp_path):
    def lose(block):
        keep = (block["tick"]["tick"] < 100) | (block["tick"]["tick"] >= 130)
        for name in ("tick", "command", "state", "check"):
            block[name] = block[name][keep]

    result, _ = measured(synthetic_run.write_run(tmp_path / "run.mcap", 500, edit=lose))
    assert (result.lost_count, result.skipped_count, result.miss_count) == (30, 0, 0)
    assert result.distributions["wake_lateness"].count == 470
    assert result.distributions["period"].values_ns["max"] < 1_300_000  # the step over the gap is no period


def test_warm_up_is_left_out(tmp_path):
    def slow_start(block):
        block["tick"]["end_mono_ns"][:20] += 50_000_000

    profile = synthetic_run.PROFILE + "[bench]\nwarm_up_ticks = 20\n"
    path = synthetic_run.write_run(tmp_path / "run.mcap", 500, edit=slow_start, profile_text=profile)
    run = read_run(path)
    facts = read_facts(run)
    run.metadata["run"].pop("warm_up_ticks")
    facts = read_facts(run)
    assert facts.warm_up_ticks == 20
    result = latency.measure_latency(run, facts, np.zeros(0, np.int64))
    assert result.warm_up_ticks == 20
    assert result.distributions["execution"].values_ns["max"] < 1_000_000


def test_responses_come_from_frames_or_from_the_loop(tmp_path):
    path = synthetic_run.write_run(tmp_path / "run.mcap", 300)
    result, run = measured(path, [100, 300, 200])
    assert result.distributions["response"].values_ns["max"] == 300
    assert result.distributions["response"].source == "frames"
    without, _ = measured(path)
    assert "response" not in without.distributions
    rows = records.allocate(records.STATISTICS, 1)
    rows["response_ns_p50"], rows["response_ns_max"] = 111, 999
    run.topics["/rt/statistics"] = rows
    told = latency.measure_latency(run, read_facts(run), np.zeros(0, np.int64)).distributions["response"]
    assert (told.values_ns["p50"], told.values_ns["max"], told.count) == (111, 999, 0)
    assert told.source == "the loop's histogram"


def test_an_empty_run_has_no_figures(tmp_path):
    run = read_run(synthetic_run.write_run(tmp_path / "run.mcap", 3))
    run.topics.clear()
    result = latency.measure_latency(run, read_facts(run), np.zeros(0, np.int64))
    assert (result.tick_count, result.duration_s, result.distributions) == (0, 0.0, {})


@pytest.mark.parametrize("phase", [records.PHASE_WAKE, status.PHASE_STEP])
def test_phases_have_names(tmp_path, phase):
    def of_phase(block):
        block["miss"]["phase"] = phase
        block["miss"]["cpu"] = 3

    result, _ = measured(synthetic_run.write_run(tmp_path / "run.mcap", 1200, stall_every=1000, edit=of_phase))
    assert result.misses[0].phase == ("wake-up" if phase == records.PHASE_WAKE else "step")
    assert "core 0 to 3" in result.misses[0].detail
