"""The systemd unit by systemd's own rules (systemd.kill(5)): a recorder whose runner has crashed finishes the log.

`tests/long/test_systemd.py` tries the same under a real systemd.
"""

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

from hilrunner.base.errors import LogError
from hilrunner.cli import build_parser
from hilrunner.evidence.reader import read_run
from hilrunner.setup import session
from tests.rules import tree

FOLDER = tree.ROOT / "tools" / "systemd"
UNIT = FOLDER / "hilrunner@.service"
RUN = ["run", "--stimulus", "hold", "--priority", "0", "--log", "run.mcap"]
# KillMode → what a process that is not the main one gets at once when the main process has crashed; later all get SIGKILL
AFTER_A_CRASH = {"control-group": "KillSignal", "mixed": signal.SIGKILL, "process": None, "none": None}


def settings() -> dict[str, str]:
    """Keys of the section [Service]; the last one of a name counts."""
    section = UNIT.read_text().partition("[Service]")[2].partition("\n[")[0]
    return dict(re.findall(r"^(\w+)=(.*)$", section, re.MULTILINE))


def at_once(unit: dict[str, str]) -> int | None:
    """The signal for what a crash of the runner leaves."""
    number = AFTER_A_CRASH[unit.get("KillMode", "control-group")]
    return getattr(signal, unit.get("KillSignal", "SIGTERM")) if number == "KillSignal" else number


def holds_ticks(log: Path) -> bool:
    """True once the recorder has written the first ones, a second after the start of the clock."""
    try:
        read_run(log)
    except LogError:
        return False
    return True


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_recorder_whose_runner_has_crashed_finishes_the_log(tmp_path):
    runner = subprocess.Popen([sys.executable, "-m", "hilrunner", *RUN], cwd=tmp_path, stdout=subprocess.DEVNULL)
    log, recorder = tmp_path / "run.mcap", None
    while not holds_ticks(log):
        assert runner.poll() is None
        time.sleep(0.05)
    (recorder,) = children(runner.pid)
    watch = os.pidfd_open(recorder)
    signal.pidfd_send_signal(watch, signal.SIGSTOP)  # so that it has not finished before systemd acts
    runner.kill()
    runner.wait()
    number = at_once(settings())
    if number is not None:
        signal.pidfd_send_signal(watch, number)
    signal.pidfd_send_signal(watch, signal.SIGCONT)
    select.select([watch], [], [])  # readable when the process has ended
    os.close(watch)
    run = read_run(log)
    assert not run.damage, json.dumps(run.metadata["run"])


def test_what_hangs_is_ended_and_later_than_the_runner_waits():
    unit = settings()
    assert unit["KillMode"] == "control-group", "process and none leave a recorder that hangs for ever"
    assert float(unit["TimeoutStopSec"]) > session._RECORDER_WAIT_S
    assert unit["KillSignal"] == "SIGINT" and unit["OOMPolicy"] == "continue"


def test_its_command_line_is_one_that_the_runner_takes():
    words = settings()["ExecStart"].replace("%i", "can0").replace("$OPTIONS", "--cpu -1").split()
    assert words[:3] == ["/usr/bin/env", "hilrunner", "run"]
    assert build_parser("run").parse_args(words[3:]).can == "can0"


def test_the_files_it_names_are_there():
    for path in FOLDER.iterdir():
        for name in re.findall(r"install -m 644 (\S+) ", path.read_text()):
            assert (FOLDER / name).is_file(), f"{path.name}: {name}"
