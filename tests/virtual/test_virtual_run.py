"""A whole run in virtual time: deterministic to the last bit, logged, judged and replayed as any other; and what ends one early."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.replay import ReplayOptions, build_replay
from hilrunner.setup.profile import load_profile
from hilrunner.setup.session import RunOptions
from hilrunner.setup.virtual_session import VirtualOptions, VirtualSession
from hilrunner.virtual.world import Firmware, VirtualBus

ROOT = Path(__file__).resolve().parents[2]
C_FOLDER = ROOT / "firmware_iface" / "c"
PROFILE = "wave-hs05"
IDEAL = (VirtualBus(),)


@pytest.fixture(scope="module")
def firmware():
    """The reference firmware, unmodified."""
    subprocess.run(["make", "-s", "-C", str(C_FOLDER), "reference_firmware"], check=True)
    return str(C_FOLDER / "build" / "reference_firmware")


def run(command, log, duration_s=3.0, buses=IDEAL):
    """One run; its result."""
    options = RunOptions(duration_s=duration_s, log_path=log)
    session = VirtualSession(load_profile(PROFILE), options, VirtualOptions(buses, (Firmware(command),)))
    session.start()
    while session.running(0.05):
        pass
    return session.finish()


def digest(log) -> str:
    """SHA-256 over all states, commands and frames of a log."""
    found = hashlib.sha256()
    topics = read_run(log).topics
    for name in sorted(topics):
        if name.endswith(("/state", "/command")) or name.startswith("/can/"):
            rows = topics[name]
            found.update(name.encode())
            for field in rows.dtype.names[2:]:
                found.update(np.ascontiguousarray(rows[field]).tobytes())
    return found.hexdigest()


@pytest.fixture(scope="module")
def first(firmware, tmp_path_factory):
    """(log, result) of one run."""
    log = tmp_path_factory.mktemp("virtual") / "first.mcap"
    return log, run([firmware, "-i", "vcan0"], log)


def test_a_run_ends_as_planned_and_the_firmware_drives_the_crane(first):
    _, result = first
    progress = result.armed.bench.progress[0]
    assert result.exit_reason == status.EXIT_DURATION
    assert (progress["tick_count"], progress["miss_count"], progress["skipped_count"]) == (3000, 0, 0)
    assert progress["frames_received"] == 2999  # sent at each millisecond, received by the tick after it
    assert result.firmware[0].exit_code == 0
    assert result.mode == "virtual time"
    assert result.recorder["dropped_ticks"] == result.recorder["dropped_frames"] == 0


def test_the_same_firmware_gives_the_same_bits(first, firmware, tmp_path):
    log, _ = first
    again = tmp_path / "again.mcap"
    run([firmware, "-i", "vcan0"], again)
    assert digest(again) == digest(log)
    other = tmp_path / "other.mcap"
    run([firmware, "-i", "vcan0", "--gain", "1.5"], other)
    assert digest(other) != digest(log)


def test_it_replays_bit_for_bit_and_was_cross_checked(first):
    log, result = first
    replay = build_replay(log, ReplayOptions(part="exact", duration_s=None, rtol=1e-11), lambda *_: None)
    assert replay.exact.identical
    checked = result.recorder["check"]["luffing"]
    assert checked["checked_ticks"] == 3000 and 0.0 < checked["chamber_1_pressure_error_pa_max"] < 1e4


def test_a_firmware_that_dies_leaves_the_crane_in_its_fail_safe(firmware, tmp_path):
    log = tmp_path / "dead.mcap"
    result = run([firmware, "-i", "vcan0", "--die-after-s", "1"], log, 2.0)
    assert result.exit_reason == status.EXIT_DURATION
    command = read_run(log).topics["/luffing/command"]
    latched = command[command["mode"] == status.MODE_FAIL_SAFE]
    rules = load_profile(PROFILE).profile.axis[0].command
    limit_ns = round((rules.stale_after_ms + rules.hold_for_ms + rules.ramp_for_ms) * 1e6)
    assert latched["age_ns"][0] == limit_ns + 1_000_000  # the first period past the limit


def test_a_bus_with_a_bit_rate_makes_the_answer_late(firmware, first, tmp_path):
    log = tmp_path / "timed.mcap"
    result = run([firmware, "-i", "vcan0"], log, 1.0, (VirtualBus(bitrate=1_000_000),))
    assert result.exit_reason == status.EXIT_DURATION
    received = read_run(log).topics["/can/rx"]
    late_ns = received["kernel_real_ns"] % 1_000_000
    assert 0 < late_ns.min() and late_ns.max() < 1_000_000  # complete some bits after the millisecond, within it


def command_line(*words, folder):
    """`hilrunner run --virtual` as a process: exit code, stdout, stderr."""
    line = [sys.executable, "-m", "hilrunner", "run", "--virtual", *map(str, words)]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def test_the_command_tells_what_the_run_was(firmware, tmp_path):
    words = ["--profile", PROFILE, "--duration", "1", "--log", "run.mcap", "--json", "--", firmware, "-i", "vcan0"]
    code, out, _ = command_line(*words, folder=tmp_path)
    summary = json.loads(out.splitlines()[-1])
    assert code == 0 and summary["mode"] == "virtual time" and summary["tick_count"] == 1000
    assert summary["firmware"][0]["exit_code"] == 0


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ((), "no firmware to run"),
        (("--", "./missing"), "no such program"),
        (("--interface", "virtual", "--", "sleep", "1"), "has no meaning in virtual time"),
    ],
)
def test_what_cannot_be_run_is_one_line(words, problem, tmp_path):
    code, _, err = command_line("--duration", "1", "--no-log", *words, folder=tmp_path)
    assert code == 2 and problem in err and len(err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
