"""Bad frames, a lost interface, a full disk: counters and documented exit codes, never a wrong motion."""

import itertools
import os
import random
import signal
import subprocess
import time

import e2e.p02
import numpy as np
import pytest

from hilrunner.base import exit_codes, status
from tests.tools import contract, vcan_bench
from tests.vcan.test_main_job import complete

FUZZED_FRAMES = 100_000
BATCH = 256  # frames between two breaths, so that the one core of the lab also runs the bench


def fuzz(seed):
    """Random frames, half of them with the identifier of the command; none that an independent check calls valid."""
    source = random.Random(seed)
    data_ids = contract.data_ids("VALVE_COMMAND_1")
    while True:
        can_id = vcan_bench.COMMAND_ID if source.random() < 0.5 else source.randrange(0x800)
        if source.random() < 0.05:
            can_id |= source.choice([0x40000000, 0x80000000])  # remote, extended
        length = 8 if source.random() < 0.7 else source.randrange(9)
        data = bytearray(source.randbytes(8))
        if length == 8 and e2e.p02.e2e_p02_check(bytes(data), data_ids):
            data[0] ^= 0x55
        yield can_id, bytes(data), length


def test_fuzzed_frames_change_nothing_but_counters(bench):
    frames = list(itertools.islice(fuzz(seed=7), FUZZED_FRAMES))
    running = bench(log=None)
    with vcan_bench.RawBus() as bus:
        bus.socket.setsockopt(vcan_bench.socket.SOL_CAN_RAW, vcan_bench.socket.CAN_RAW_FILTER, b"")
        for first in range(0, FUZZED_FRAMES, BATCH):
            vcan_bench.send_fast(bus, frames[first : first + BATCH])
            time.sleep(0.002)
        time.sleep(0.5)
        bus.send(0x7FF, bytes(8))  # the kernel tells of dropped frames with the next one it delivers
        time.sleep(0.2)
    code = running.end(signal.SIGINT)
    summary = running.summary()
    assert code == exit_codes.VERDICT_FAILED, summary
    assert [cause.split(":")[0] for cause in summary["verdict"]["causes"]] == ["firmware_heard"], (
        "not one frame was valid"
    )
    (axis,) = summary["axes"]
    assert axis["mode"] == "waiting"
    assert axis["rod_position_mm"] == pytest.approx(600.0, abs=0.01)
    counts = [row for rows in summary["frames"].values() for row in rows.items()]
    assert "valid" not in dict(counts)
    assert {"bad crc", "unknown id", "wrong length", "remote frame"} <= dict(counts).keys()
    assert sum(count for _, count in counts) + summary["frames_kernel_dropped"] == FUZZED_FRAMES + 1


def test_a_hand_made_command_moves_the_rod(bench):
    """cansend of a golden frame (Active, +100 %): the rod extends, then the bench goes to fail-safe for want of a second one."""
    (golden,) = [
        frame for frame in contract.golden_frames()
        if frame.can_id == vcan_bench.COMMAND_ID and frame.values.get("valve_setpoint") == 100 and frame.values["control"] == 2
    ]  # fmt: skip
    running = bench()
    time.sleep(0.3)
    subprocess.run(["cansend", "vcan0", f"{golden.can_id:03X}#{golden.data.hex()}"], check=True)
    time.sleep(1.0)
    assert running.end(signal.SIGINT) == exit_codes.PASSED
    run = running.run()
    (axis,) = run.axis_names
    position = run.state[axis]["rod_position_m"]
    assert position[-1] - position[0] > 0.0005
    applied = run.command[axis]["valve_command"]
    assert applied.max() == 1.0
    modes = run.command[axis]["mode"]
    order = [status.MODE_NAMES[mode] for mode in modes[np.flatnonzero(np.diff(modes, prepend=255))]]
    assert order == ["waiting", "active", "stale-hold", "stale-ramp", "fail-safe"]
    received = run.can_rx
    assert len(received) == 1 and bytes(received[0]["data"]) == golden.data
    assert received[0]["kernel_real_ns"] > 0


def test_an_interface_that_goes_down_ends_the_run_with_4(bench):
    running = bench()
    time.sleep(0.5)
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    assert running.end() == exit_codes.CAN_LOST
    summary = running.summary()
    assert summary["exit_reason"] == "CAN lost"
    assert summary["bus_error"]
    complete(running.run())


def test_an_interface_that_is_down_is_refused_with_the_remedy(bench):
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    refused = bench(wait=False)
    assert refused.end() == exit_codes.CAN_LOST
    assert "vcan0" in refused.err and "ip link set vcan0 up" in refused.err
    assert not refused.log.exists()


def test_an_interface_that_is_missing_is_refused_with_the_remedy(bench):
    refused = bench("--can", "vcan9", wait=False)
    assert refused.end() == exit_codes.CAN_LOST
    assert "vcan9" in refused.err and "remedy" in refused.err
    assert not refused.log.exists()


def test_a_full_disk_costs_log_but_not_the_run(bench, tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=150k", "tmpfs", str(small)], check=True)
    try:
        running = bench("--duration", "12", log="small/run.mcap")
        code = running.end()
        summary = running.summary()
        assert summary["exit_reason"] == "duration reached"
        assert code == exit_codes.VERDICT_FAILED
        causes = " ".join(summary["verdict"]["causes"])
        assert "ticks_lost_max: failed" in causes
        # the closing counts are among what the disk may have refused: then the log is not finished
        assert "frames_lost_max: failed" in causes or "log_finished: failed" in causes
        assert summary["tick_count"] + summary["skipped_count"] >= 12e6 / vcan_bench.PERIOD_US - 1
        assert summary["recorder"]["lost_bytes"] > 0
        run = running.run()
        assert len(run.tick) > 100 and int(run.metadata["run"].get("lost_bytes", 1)) > 0
    finally:
        subprocess.run(["umount", "-l", str(small)], check=True)


def test_a_log_that_cannot_be_written_is_refused_before_the_clock(bench, tmp_path):
    (tmp_path / "file").write_text("")
    refused = bench(wait=False, log="file/run.mcap")
    assert refused.end() == exit_codes.BAD_INPUT
    assert os.fspath(tmp_path / "file") in refused.err
