"""Inside the lab: a bench under systemd's user manager, whose runner is killed: systemd_in_lab.py FOLDER KILL_MODE

A manager puts all processes of its control group into a group of its own, which takes their right to real time away: on the kernel of
a machine in use it must not be started. Prints one JSON line: whether the log it leaves is damaged.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

from hilrunner.evidence.reader import read_run
from tests.packaging import test_systemd_unit as unit

MANAGER = "/lib/systemd/systemd"
KILLING = ("Type", "KillMode", "KillSignal", "TimeoutStopSec", "OOMPolicy")
LIMIT_S = 500.0


def service(log: Path, mode: str) -> str:
    """The shipped unit as far as it is about killing, around a run without a bus."""
    kept = {key: value for key, value in unit.settings().items() if key in KILLING} | (
        {"KillMode": mode} if mode else {}
    )
    words = [sys.executable, "-m", "hilrunner", *unit.RUN[:-1], str(log)]
    lines = [f"{key}={value}" for key, value in kept.items()]
    lines += [f"ExecStart={shlex.join(words)}", f"WorkingDirectory={log.parent}"]
    lines += [
        f'Environment="{name}={os.environ[name]}"' for name in os.environ if name.startswith(("PYTHON", "HILRUNNER"))
    ]
    return "[Service]\n" + "\n".join([*lines, f"Environment=HOME={os.environ['HOME']}"]) + "\n"


def start_manager(folder: Path, text: str) -> subprocess.Popen:
    """A user's manager with nothing but this service."""
    home, runtime = folder / "home", Path("/run/manager")
    units = home / ".config" / "systemd" / "user"
    units.mkdir(parents=True)
    (units / "bench.service").write_text(text)
    runtime.mkdir(mode=0o700)
    Path("/run/systemd/system").mkdir(parents=True)
    subprocess.run(["mount", "-t", "cgroup2", "none", "/sys/fs/cgroup"], check=True)
    environment = os.environ | {"HOME": str(home), "XDG_RUNTIME_DIR": str(runtime)}
    words = [MANAGER, "--user", "--unit=bench.service", "--log-target=console"]
    return subprocess.Popen(words, env=environment)


def until(found):
    """Wait for something that is true."""
    deadline_s = time.monotonic() + LIMIT_S
    while not (value := found()):
        if time.monotonic() > deadline_s:
            raise SystemExit("not within the limit")
        time.sleep(0.1)
    return value


def naming(log: Path) -> list[int]:
    """Processes whose command line names the log."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:
                continue
            found += [int(entry.name)] if str(log).encode() in words else []
    return found


def main() -> None:
    """Start, kill, wait for the recorder's end, look at the log."""
    if "User Mode Linux" not in Path("/proc/cpuinfo").read_text():
        raise SystemExit(
            "only inside `hilrunner lab --lab uml`: elsewhere a manager would move every process of the machine"
        )
    folder, mode = Path(sys.argv[1]), sys.argv[2].replace("shipped", "")
    log = folder / "run.mcap"
    start_manager(folder, service(log, mode))
    until(lambda: unit.holds_ticks(log))
    (runner,) = naming(log)
    (recorder,) = unit.children(runner)
    os.kill(recorder, signal.SIGSTOP)  # the manager acts first, and its signal wakes it
    os.kill(runner, signal.SIGKILL)
    until(lambda: not os.path.exists(f"/proc/{recorder}"))
    print(json.dumps({"damaged": bool(read_run(log).damage)}))


if __name__ == "__main__":
    main()
