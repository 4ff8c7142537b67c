"""A bench at work, to be attacked while it runs: a run by a stimulus in a forked child, with its own recorder process."""

import contextlib
import io
import json
import os
import resource
import signal
import sys
import time
import traceback
from pathlib import Path

from hilrunner import cli
from hilrunner.base.errors import HilrunnerError
from hilrunner.evidence.reader import read_run
from tests.attack.outcome import HANG_S, Outcome, call

PROFILE = """name = "attacked"

[[axis]]
name = "luffing"
circuit = "lift"
preset = "lift"
initial_position_mm = 600.0

[bench]
engine = "reference"
warm_up_ticks = 0

[crosscheck]
enabled = false

[limits]
pressure_mpa_max = 60.0
ticks_lost_max = 0
"""
DOCUMENTED = {0, 1, 2, 3, 4, 5, 6, 7, 8, 130, 141}
PERIOD_S = 1e-3
END_WITHIN_S = 3 * HANG_S  # a run of a second with its recorder, on a machine that does much else


def warm_up(folder: Path) -> None:
    """Load and compile in this process what a run and its report need, so that the children find it."""
    (folder / "attacked.toml").write_text(PROFILE)
    log = folder / "warm.mcap"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        for words in (
            run_words(folder, log, 0.2),
            ["report", str(log), "--json"],
            ["replay", str(log), "--only", "exact", "--json"],
        ):
            assert cli.main(words) in (0, 1, 8)


def run_words(folder: Path, log: Path, duration_s: float, profile: Path | None = None) -> list[str]:
    """The words of a run."""
    return [
        "run", "--profile", str(profile or folder / "attacked.toml"), "--stimulus", "lift-hold-lower-hold", "--priority", "0",
        "--duration", f"{duration_s:g}", "--log", str(log),
    ]  # fmt: skip


class Bench:
    """One run in a child of this process.

    Args:
        file_bytes_max: RLIMIT_FSIZE of runner and recorder: a disk that is full at that size; None: none.
        environment: set for runner and recorder, which is a new program then; None: the child goes on with what is loaded.
    """

    def __init__(
        self,
        folder: Path,
        duration_s: float,
        file_bytes_max: int | None = None,
        environment: dict[str, str] | None = None,
    ) -> None:
        self._environment = environment
        self.folder, self.log, self.duration_s = folder, folder / "run.mcap", duration_s
        (folder / "attacked.toml").write_text(PROFILE)
        self.begin_s = time.monotonic()
        self.code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            self._be_the_runner(file_bytes_max)

    def recorders(self) -> list[int]:
        """Processes of the recorder: children of the runner."""
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                words = (entry / "stat").read_text().rsplit(")", 1)[1].split()
                if int(words[1]) == self.pid and b"record" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
        return found

    def wait_until(self, share: float) -> None:
        """Until that share of the run has passed, counted from the log's first chunk of bytes; negative: that many seconds after the start."""
        if share < 0:
            time.sleep(-share)
            return
        end_s = time.monotonic() + END_WITHIN_S
        while time.monotonic() < end_s and not self._ended() and not self._has_begun():
            time.sleep(0.005)
        time.sleep(share * self.duration_s)

    def send(self, number: int, pid: int | None = None) -> bool:
        """A signal to the runner, or to `pid`; False when it is gone."""
        try:
            os.kill(self.pid if pid is None else pid, number)
        except ProcessLookupError:
            return False
        return True

    def finish(self, recorders: list[int]) -> Outcome:
        """Wait for runner and recorder; the runner's outcome."""
        end_s = time.monotonic() + END_WITHIN_S
        while time.monotonic() < end_s and not self._ended():
            time.sleep(0.01)
        hung = not self._ended()
        for pid in recorders:
            while time.monotonic() < end_s and _is_alive(pid):
                time.sleep(0.01)
            hung |= _is_alive(pid)
            if hung:
                self.send(signal.SIGKILL, pid)
        if hung:
            self.send(signal.SIGKILL)
        code = None if hung else self.code
        out, err = ((self.folder / name).read_text(errors="replace") for name in ("out", "err"))
        return Outcome(code, out, err, time.monotonic() - self.begin_s, 0)

    def _ended(self) -> bool:
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is not None

    def _has_begun(self) -> bool:
        return (
            "first tick" in (self.folder / "out").read_text(errors="replace")
            if (self.folder / "out").exists()
            else False
        )

    def _be_the_runner(self, file_bytes_max: int | None) -> None:
        code = 70
        try:
            os.setsid()
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.chdir(self.folder)
            for name, number in (("out", 1), ("err", 2)):
                file = os.open(self.folder / name, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
                os.dup2(file, number)
            sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
            if file_bytes_max is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes_max, file_bytes_max))
            if self._environment is not None:
                command = [sys.executable, "-m", "hilrunner", *run_words(self.folder, self.log, self.duration_s)]
                os.execve(sys.executable, command, {**os.environ, **self._environment})
            code = cli.main(run_words(self.folder, self.log, self.duration_s))
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)


def judge_log(log: Path, planned_periods: int | None) -> tuple[str, list[str]]:
    """What the log of an attacked run says: (words, faults). A pass is right only where every period of the run is there.

    Args:
        planned_periods: of the whole run; None: it was to end early.
    """
    if not log.exists() or not log.stat().st_size:
        return "no log", []
    outcome = call(["report", str(log), "--json"])
    faults = [f"report: {fault}" for fault in outcome.faults()]
    if outcome.code not in DOCUMENTED:
        faults.append(f"report: exit code {outcome.code}")
    if outcome.code == 7:
        faults.append("report: damaged, though nobody changed a byte")
    try:
        run = read_run(log)
    except HilrunnerError:
        return f"report {outcome.code}", faults + (["silent pass of an unreadable log"] if outcome.code == 0 else [])
    periods = len(run.tick) + int(run.tick["skipped_count"].sum()) if len(run.tick) else 0
    whole = len(run.tick) > 0 and periods == int(run.tick["tick"][-1]) + 1
    reason = run.metadata.get("run", {}).get("exit_reason", "")
    if reason == "duration reached" and planned_periods is not None:
        whole &= periods >= planned_periods
    if outcome.code == 0 and not whole:
        faults.append(f"silent pass: {periods} of {planned_periods} periods in the log ({reason})")
    return f"report {outcome.code}, {reason or 'no end'}, {periods} periods", faults


def replayed(log: Path) -> list[str]:
    """Faults of the bit-exact replay of a log that holds a whole run."""
    outcome = call(["replay", str(log), "--only", "exact", "--json"])
    faults = [f"replay: {fault}" for fault in outcome.faults()]
    try:
        exact = json.loads(outcome.out)["exact"]
    except (ValueError, KeyError):
        return faults
    if exact["first"] is not None:
        faults.append(f"replay differs at {exact['first']}")
    return faults


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
