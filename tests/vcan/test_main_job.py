"""`hilrunner --can vcan0` with the reference firmware: the loop closes, loss of either side is handled as documented."""

import signal
import subprocess
import time

import numpy as np
import pytest

from hilrunner.base import exit_codes, status
from tests.tools import contract, vcan_bench

PERIOD_MS = vcan_bench.PERIOD_US / 1000
FIRMWARE = ("--ramp-s", "0.5", "--period-us", "4000")
DURATION_S = 14


def complete(run):
    """Every period from tick 0 is in the log or counted as skipped; nothing dropped, nothing damaged."""
    tick = run.tick["tick"].astype(np.int64)
    assert len(tick) > 0 and run.damage == () and run.finished
    np.testing.assert_array_equal(np.diff(tick, prepend=-1) - 1, run.tick["skipped_count"].astype(np.int64))
    assert int(run.metadata["run"]["dropped_ticks"]) == 0
    for axis in run.axis_names:
        np.testing.assert_array_equal(run.state[axis]["tick"], run.tick["tick"])
        np.testing.assert_array_equal(run.command[axis]["tick"], run.tick["tick"])


@pytest.fixture(scope="module")
def closed_loop(firmware_built, tmp_path_factory):
    """One healthy run, looked at by several tests: (exit code, summary, log, firmware's report, candump lines)."""
    folder = tmp_path_factory.mktemp("closed_loop")
    bench = vcan_bench.BenchProcess(folder, "--duration", str(DURATION_S))
    firmware = vcan_bench.Firmware(*FIRMWARE)
    vcan_bench.wait_for_control(status.CONTROL_ACTIVE)
    time.sleep(2.0)
    dump = subprocess.run(["candump", "-L", "-n", "60", "vcan0"], capture_output=True, text=True, timeout=60).stdout
    code = bench.end()
    return code, bench.summary(), bench.run(), firmware.end(), dump


def test_the_run_ends_as_planned(closed_loop):
    code, summary, run, _, _ = closed_loop
    assert code == exit_codes.PASSED, f"{summary} {[event.text for event in run.events]}"
    assert summary["exit_reason"] == run.metadata["run"]["exit_reason"] == "duration reached"
    assert summary["tick_count"] + summary["skipped_count"] >= DURATION_S * 1000 / PERIOD_MS - 1


def test_the_log_is_complete(closed_loop):
    _, summary, run, _, _ = closed_loop
    complete(run)
    assert len(run.tick) == summary["tick_count"] + summary["skipped_count"]
    assert len(run.can_rx) == summary["frames_received"]
    assert len(run.can_tx) == summary["frames_sent"]


def test_the_rod_follows_the_firmware(closed_loop):
    """Judged by the firmware, from the measurements on the bus, and seen in the log."""
    _, _, run, report, _ = closed_loop
    assert report["tracked_periods"] > 300
    assert report["reference_mm_rms"] > 1.0
    assert report["tracking_error_mm_rms"] < 0.05 * report["reference_mm_rms"]
    (axis,) = run.axis_names
    assert np.ptp(run.state[axis]["rod_position_m"]) > 0.002


def test_the_bus_decodes_with_the_dbc(closed_loop):
    *_, dump = closed_loop
    done = subprocess.run(
        ["python", "-m", "cantools", "decode", str(contract.DBC)],
        input=dump, capture_output=True, text=True, env=_path(),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for name in ("VALVE_COMMAND_1", "PRESSURES_1", "MOTION_1"):
        assert name in done.stdout
    assert "Unknown" not in done.stdout


def _path():
    import os
    import sys
    from pathlib import Path

    return {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


def test_a_lost_firmware_ends_in_latched_fail_safe(bench, firmware):
    running = bench()
    dying = firmware(*FIRMWARE)
    vcan_bench.wait_for_control(status.CONTROL_ACTIVE)
    time.sleep(1.0)
    dying.kill()
    time.sleep(1.0)
    back = firmware(*FIRMWARE)
    vcan_bench.wait_for_control(status.CONTROL_RESET)
    vcan_bench.wait_for_control(status.CONTROL_ACTIVE)
    time.sleep(1.0)
    assert running.end(signal.SIGINT) == exit_codes.PASSED
    assert back.end()["fail_safes_seen"] >= 1
    run = running.run()
    complete(run)
    (axis,) = run.axis_names
    command = run.command[axis]
    mode = command["mode"]
    assert status.MODE_ACTIVE in mode
    entered = int(np.argmax(mode == status.MODE_FAIL_SAFE))
    assert mode[entered] == status.MODE_FAIL_SAFE
    limit_ms = sum(vcan_bench.AGEING_MS.values())
    age_ms = command["age_ns"][entered] * 1e-6 - run.tick["skipped_count"][entered] * PERIOD_MS
    assert age_ms <= limit_ms + 2 * PERIOD_MS
    assert (command["valve_command"][mode == status.MODE_FAIL_SAFE] == 0.0).all()
    assert (run.state[axis]["flags"][mode == status.MODE_FAIL_SAFE] & status.FLAG_FAIL_SAFE).all()
    left = entered + int(np.argmax(mode[entered:] != status.MODE_FAIL_SAFE))
    assert command["control"][left] == status.CONTROL_RESET, "only Reset unlatches"
    assert status.MODE_ACTIVE in mode[left:]


def test_a_killed_runner_leaves_a_complete_log(bench, firmware):
    running = bench()
    moving = firmware(*FIRMWARE)
    vcan_bench.wait_for_control(status.CONTROL_ACTIVE)
    with vcan_bench.RawBus(vcan_bench.STATUS_ID) as bus:
        time.sleep(1.0)
        running.signal(signal.SIGKILL)
        last = b""
        while (data := bus.receive(0.2)) is not None:
            last = data
    running.end()
    moving.end()
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and running.log.read_bytes()[-8:] != b"\x89MCAP0\r\n":
        time.sleep(0.2)
    run = running.run()
    complete(run)
    assert run.metadata["run"]["exit_reason"] == "runner killed"
    sent = contract.database().decode_message(vcan_bench.STATUS_ID, last, decode_choices=False)["tick"]
    behind = (sent - int(run.tick["tick"][-1])) % 65536
    assert behind <= 1 or behind >= 65536 - 100, "a tick that was on the bus is not in the log"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_cleanly(bench, number):
    running = bench(json_=False)
    time.sleep(0.5)
    assert running.end(number) == exit_codes.VERDICT_FAILED, running.err
    assert "stopped by signal" in running.out
    assert "firmware_heard: failed: " in running.out and "never got a valid command" in running.out
    assert "exit code 1" in running.out
    run = running.run()
    complete(run)
    assert run.metadata["run"]["exit_reason"] == "stopped by signal"
