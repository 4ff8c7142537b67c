"""The host of a running bench stands still while the firmware goes on: nobody blames the firmware, everybody names the bench.

The bench is a process on a bus of UDP sockets (`tests/tools/socket_bench.py`); SIGSTOP stops all of its threads wherever they are.
"""

import time

import numpy as np
import pytest

from hilrunner.base import exit_codes, records, status
from hilrunner.commands.warm_up import compile_check
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.replay import EXACT, ReplayOptions, build_replay, tolerances
from hilrunner.record import crosscheck
from hilrunner.setup.axes import build_axes, period_s, reference_plants
from hilrunner.setup.profile import load_profile
from tests.tools import socket_bench

PATIENT = {
    "stale_after_ms": 200.0,
    "hold_for_ms": 100.0,
    "ramp_for_ms": 100.0,
}  # a busy machine holds the firmware up as well


@pytest.fixture(autouse=True, scope="module")
def compiled():
    """The cross-check compiled before a run needs it: a run waits for it no longer than its patience."""
    compile_check("amc-lift")


def profile_in(folder, stall="", **ageing):
    """The shipped profile with patient ageing."""
    text = load_profile("amc-lift").text
    for key, value in (PATIENT | ageing).items():
        before = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
        text = text.replace(before, f"{key} = {value}")
    path = folder / "stalled.toml"
    # a busy machine leaves the recorder's cross-check no time; `out_of_tolerance` looks at every tick instead
    path.write_text(text + stall + "\n[limits]\nunchecked_ticks_max = 1e9\n")
    return path


def stalled_run(folder, stalls, duration_s, start_delay_s=0.02, stall="", every_s=0.005):
    """One run; `stalls`: (seconds to wait, seconds to stand still) one after the other."""
    log = folder / "run.mcap"
    ours, theirs = socket_bench.peers()
    with ours, theirs:
        firmware = socket_bench.Firmware(theirs, every_s)
        options = ("--profile", str(profile_in(folder, stall)), "--log", str(log), "--duration", str(duration_s))
        bench = socket_bench.BenchOnSocket(ours, *options, start_delay_s=start_delay_s)
        bench.wait_armed()
        for wait_s, still_s in stalls:
            time.sleep(wait_s)
            bench.stand_still(still_s)
        code, summary, told = bench.end()
        firmware.end()
    return code, summary, told, read_run(log), firmware


def judge(code, summary, told, run, firmware, longest_s):
    """What must hold of every run whose host stood still."""
    period_s = summary["period_us"] * 1e-6
    ticks = run.tick["tick"].astype(np.int64)
    assert np.array_equal(ticks, np.arange(len(ticks))) and not run.tick["skipped_count"].any(), "a row of every period"
    skipped = (run.tick["flags"] & records.TICK_FLAG_SKIPPED) != 0
    assert skipped.sum() == summary["skipped_count"] == int(run.metadata["run"]["skipped_periods"])
    assert summary["skipped_count"] >= (longest_s - 0.02) / period_s
    # the firmware is not blamed: no command is older than the longest silence of the firmware itself
    (axis,) = run.axis_names
    command = run.command[axis]
    silence_s = float(np.diff(firmware.sent_mono_s).max())
    assert command["age_ns"].max() * 1e-9 <= silence_s + 3 * period_s
    if silence_s < 0.19:
        assert not (command["mode"] == status.MODE_FAIL_SAFE).any()
    received = run.can_rx
    assert (received["status"] == status.FRAME_VALID).all() and (np.diff(received["tick"].astype(np.int64)) >= 0).all()
    assert run.tick["frames_received"].sum() == len(received) == summary["frames_received"]
    assert summary["frames_kernel_dropped"] == 0 and summary["recorder"]["dropped_ticks"] == 0
    # the bench is: in the summary, live, and in the log
    assert summary["stall"]["longest_ms"] >= 1000 * longest_s - 5
    assert "the bench stalled" in told
    assert any("the bench stalled" in event.text for event in run.events)
    # and both checks of the plant hold over all of it
    assert summary["check_failed_tick"] is None
    assert out_of_tolerance(run) == 0
    exact = build_replay(run.path, ReplayOptions(part=EXACT)).exact
    assert exact.identical and exact.total_ticks == len(ticks), exact.first


def out_of_tolerance(run) -> int:
    """Ticks of a log out of the cross-check's tolerance: all of them looked at, also where the recorder's own check ran out of time."""
    loaded = load_profile(str(run.path.with_name("stalled.toml")))
    plants, (axis,) = reference_plants(loaded), run.axis_names
    start = build_axes(loaded, status.ENGINE_SURROGATE).initial_states[0]
    check = records.allocate(records.CHECK, len(run.tick))
    rows = [
        np.ascontiguousarray(one)
        for one in (run.tick["skipped_count"].astype(np.int64), run.command[axis], run.state[axis])
    ]
    walk = crosscheck.new_walk(start, float(run.state[axis]["load_scale"][0]))
    model = crosscheck.reference_model(plants, period_s(loaded))
    limits = tolerances(loaded.profile.crosscheck)
    return crosscheck.check_periods(model, 0, period_s(loaded), *rows, walk, limits, 1, np.zeros(0), check)


def test_a_run_whose_host_stood_still_for_150_ms_and_for_a_second(tmp_path):
    code, summary, told, run, firmware = stalled_run(tmp_path, [(1.0, 0.15), (0.7, 1.0)], 4.0)
    judge(code, summary, told, run, firmware, 1.0)
    assert code == exit_codes.BENCH_FAILED and summary["exit_reason"] == "duration reached"
    assert (
        summary["verdict"]["causes"][0].startswith("bench_served: failed")
        and "says nothing about the firmware" in summary["verdict"]["causes"][0]
    )
    assert len(run.tick) == 4000 and summary["stall"]["count"] >= 2


@pytest.mark.parametrize(("start_delay_s", "stalls"), [(0.3, [(0.0, 1.0)]), (0.02, [(0.5, 1.5)])], ids=["start", "end"])
def test_a_stall_over_the_start_or_the_end(tmp_path, start_delay_s, stalls):
    code, summary, told, run, firmware = stalled_run(tmp_path, stalls, 1.2, start_delay_s)
    judge(code, summary, told, run, firmware, 0.6)
    assert code == exit_codes.BENCH_FAILED and summary["exit_reason"] == "duration reached"
    assert len(run.tick) == 1200, "the plant went through every period that was planned"


def test_a_profile_may_allow_a_stall_or_end_the_run_for_it(tmp_path):
    allowed = "\n[deadline.stall_ms]\nmax = 60000\n"
    code, summary, _, run, _ = stalled_run(tmp_path, [(0.4, 0.3)], 1.0, stall=allowed)
    assert code == exit_codes.PASSED and summary["stall"]["count"] == 0 and len(run.tick) == 1000
    ends = '\n[deadline.stall_ms]\nmax = 200\naction = "stop"\n'
    folder = tmp_path / "ends"
    folder.mkdir()
    code, summary, told, run, _ = stalled_run(folder, [(0.4, 0.5)], 60.0, stall=ends)
    assert code == exit_codes.BENCH_FAILED and summary["exit_reason"] == "the host stalled"
    assert "the bench stalled" in told and run.metadata["run"]["stall_count"] == "1"
