"""A crash of the runner under a real systemd, started here as a user's own manager: the recorder finishes the log.

Needs Debian's package systemd, which need not be what the machine has booted with.
"""

import os
import shlex
import signal
import subprocess
import sys
import time

import pytest

from hilrunner.evidence.reader import read_run
from tests.packaging import test_systemd_unit as unit
from tests.rules import tree

MANAGER = "/lib/systemd/systemd"
KILLING = ("Type", "KillMode", "KillSignal", "TimeoutStopSec", "OOMPolicy")
LIMIT_S = 300.0


@pytest.fixture
def manager(tmp_path):
    """Start a service under a manager in a mount namespace of its own; what is left of it is ended afterwards."""
    if not os.path.exists(MANAGER):
        pytest.fail(f"no {MANAGER}; apt-get install --no-install-recommends systemd", pytrace=False)
    started = []

    def start(service: str) -> subprocess.Popen:
        home, runtime = tmp_path / "home", tmp_path / "runtime"
        (home / ".config" / "systemd" / "user").mkdir(parents=True)
        runtime.mkdir(mode=0o700)
        (home / ".config" / "systemd" / "user" / "bench.service").write_text(service)
        program = (
            "mount -t tmpfs none /run && mkdir -p /run/systemd/system && "
            f"HOME={home} XDG_RUNTIME_DIR={runtime} exec {MANAGER} --user --unit=bench.service --log-target=null"
        )
        rights = [] if os.geteuid() == 0 else ["-r"]
        words = ["unshare", *rights, "-m", "--propagation", "private", "sh", "-c", program]
        started.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return started[-1]

    yield start
    for process in started:
        process.terminate()
        process.wait()


def until(found):
    deadline_s = time.monotonic() + LIMIT_S
    while not (value := found()):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    return value


def command_lines(log) -> dict[int, list[str]]:
    """Processes that name the log, and their children's."""
    lines = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                with open(f"/proc/{entry}/cmdline", "rb") as file:
                    lines[int(entry)] = file.read().decode(errors="replace").split("\0")
            except OSError:
                continue
    return {pid: words for pid, words in lines.items() if str(log) in words}


@pytest.mark.parametrize("mode", ["as shipped", "mixed"])
def test_the_recorder_outlives_a_crash_as_shipped_and_not_with_mixed(manager, tmp_path, mode):
    kept = {key: value for key, value in unit.settings().items() if key in KILLING}
    kept |= {} if mode == "as shipped" else {"KillMode": "mixed"}
    log = tmp_path / "run.mcap"
    words = [sys.executable, "-m", "hilrunner", *unit.RUN[:-1], str(log)]
    lines = [f"{key}={value}" for key, value in kept.items()]
    lines += [f"ExecStart={shlex.join(words)}", f"Environment=PYTHONPATH={tree.ROOT}", f"WorkingDirectory={tmp_path}"]
    lines += [
        f"Environment=HILRUNNER_CACHE={os.environ.get('HILRUNNER_CACHE', os.path.expanduser('~/.cache/hilrunner'))}"
    ]
    manager("[Service]\n" + "\n".join(lines) + "\n")
    until(lambda: unit.holds_ticks(log))
    (runner,) = command_lines(log)
    (recorder,) = unit.children(runner)
    os.kill(recorder, signal.SIGSTOP)  # the manager acts first, and its signal wakes it
    os.kill(runner, signal.SIGKILL)
    until(lambda: not os.path.exists(f"/proc/{recorder}"))
    assert bool(read_run(log).damage) == (mode == "mixed")
