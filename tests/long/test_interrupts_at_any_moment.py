"""SIGINT and SIGTERM after random times of a run: it ends at once with nothing left behind, or with a whole log and its verdict."""

import signal
import subprocess
import sys
import time

from hilrunner.base import exit_codes
from hilrunner.commands.interrupt import INTERRUPTED
from hilrunner.evidence.reader import read_run

COUNT = 60
END_WITHIN_S = 60.0  # a machine under load; a run that never ends is the failure


def _whole_run_s(folder):
    """How long a short run takes here and now, after one that compiled what was not compiled yet."""
    for _ in range(2):
        begun_s = time.monotonic()
        words = ["run", "--stimulus", "hold", "--priority", "0", "--no-log", "--duration", "0.2"]
        subprocess.run([sys.executable, "-m", "hilrunner", *words], cwd=folder, check=True, capture_output=True)
    return time.monotonic() - begun_s


def test_a_run_ends_well_at_every_moment(tmp_path, drawn):
    latest_s = 2.0 * _whole_run_s(tmp_path)
    outcomes = {"before the first tick": 0, "in the run": 0}
    for index in range(COUNT):
        folder = tmp_path / str(index)
        folder.mkdir()
        number = drawn.choice([signal.SIGINT, signal.SIGTERM])
        delay_s = drawn.uniform(0.1, latest_s)
        outcomes[_ended(folder, int(number), delay_s)] += 1
    print(outcomes)
    assert min(outcomes.values()) > 0, f"the moments drawn do not cover both cases: {outcomes}"


def _ended(folder, number, delay_s):
    """One run and one signal; which of the two documented ends it came to."""
    words = ["run", "--stimulus", "hold", "--priority", "0", "--log", "run.mcap"]
    process = subprocess.Popen(
        [sys.executable, "-m", "hilrunner", *words], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: [signal.signal(one, signal.SIG_DFL) for one in (signal.SIGINT, signal.SIGTERM)],
    )  # fmt: skip
    time.sleep(delay_s)
    process.send_signal(number)
    out, err = process.communicate(timeout=END_WITHIN_S)
    told = f"signal {number} after {delay_s:.3f} s: exit {process.returncode}\n{out}\n{err}"
    assert "Traceback" not in err, told
    if process.returncode in (INTERRUPTED, -number):  # the latter: Python itself was not up yet
        assert not list(folder.iterdir()), told
        return "before the first tick"
    assert process.returncode in (exit_codes.PASSED, exit_codes.VERDICT_FAILED), told
    run = read_run(folder / "run.mcap")
    assert not run.damage and run.metadata["run"]["exit_reason"] == "stopped by signal", told
    return "in the run"
