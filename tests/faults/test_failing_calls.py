"""System calls of a running bench fail for good, in the middle of the run: the compiled loop, the real recorder, a preloaded library.

Every place of every call of the loop is tried on a simulated kernel (`tests/unit/realtime/test_system_calls.py`).
"""

import errno
import os
import tempfile

import pytest

from hilrunner.base import exit_codes
from hilrunner.setup.profile import load_profile
from tests.tools import socket_bench
from tools import failing_calls


@pytest.fixture(scope="module")
def library():
    with tempfile.TemporaryDirectory() as folder:
        from pathlib import Path

        yield failing_calls.build(Path(folder))


def run(folder, environment, duration_s=1.5, broken=None):
    """(exit code, summary, stderr) of a run; `broken` is a file that is made once the head of the log is written."""
    profile = folder / "told.toml"
    profile.write_text(load_profile("amc-lift").text + '\n[deadline.stall_ms]\naction = "warn"\n')
    ours, theirs = socket_bench.peers()
    with ours, theirs:
        firmware = socket_bench.Firmware(theirs)
        options = ("--profile", str(profile), "--log", str(folder / "run.mcap"), "--duration", str(duration_s))
        bench = socket_bench.BenchOnSocket(ours, *options, environment=environment)
        bench.wait_armed()
        if broken is not None:
            broken.touch()
        found = bench.end()
        firmware.end()
    return found


@pytest.mark.parametrize(
    ("call", "code", "exit_code", "reason", "named"),
    [
        ("clock_nanosleep", errno.EINVAL, exit_codes.BENCH_FAILED, "system call failed", "clock_nanosleep: EINVAL"),
        ("recvmmsg", errno.EINTR, exit_codes.CAN_LOST, "CAN lost", "EINTR"),
        ("sendmmsg", errno.ENXIO, exit_codes.CAN_LOST, "CAN lost", "ENXIO"),
    ],
)
def test_a_call_of_the_loop_that_fails_for_good_ends_the_run_and_is_named(
    tmp_path, library, call, code, exit_code, reason, named
):
    report = tmp_path / "calls.txt"
    environment = failing_calls.environment(
        library, call, code, first=500, process="socket_bench", thread="other", report=report
    )
    found, summary, told = run(tmp_path, environment)
    assert found == exit_code and summary["exit_reason"] == reason, told
    assert named in summary["bus_error"] and 0 < summary["tick_count"] < 1500
    assert "Traceback" not in told
    name, counted, failed = report.read_text().split()
    assert name == call and 0 < int(failed) <= int(counted) - 499 < 500, "and not called for ever"


def test_a_disk_that_fails_for_good_costs_the_log_and_nothing_else(tmp_path, library):
    broken = tmp_path / "broken"
    disk, process = failing_calls.DISK_WRITE, failing_calls.RECORDER
    environment = failing_calls.environment(library, disk, errno.EIO, process=process, once=broken)
    found, summary, told = run(tmp_path, environment, 2.5, broken)
    assert summary["exit_reason"] == "duration reached" and summary["recorder"]["lost_bytes"] > 0
    assert found == exit_codes.VERDICT_FAILED and "the disk of the log refuses data" in told
    assert "Traceback" not in told and os.path.exists(tmp_path / "run.mcap")
