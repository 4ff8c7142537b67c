"""Runs that are killed, signalled, stopped, or whose disk refuses them: what is in the log afterwards, and whether anybody is told."""

import errno
import os
import signal
import time
from pathlib import Path

import numpy as np

from tests.attack.bench import DOCUMENTED, PERIOD_S, Bench, judge_log, replayed, warm_up
from tests.attack.campaign import Attempt, Campaign, Tried
from tests.attack.outcome import Outcome
from tools import failing_calls

DURATION_S = 0.8
_PLANNED = round(DURATION_S / PERIOD_S)


def _tried(what: str, group: str, outcome: Outcome, faults: list[str], words: str) -> Tried:
    return Tried(
        f"{what}: {words}", group, outcome.code, faults, outcome.wall_s, 0, (outcome.out + outcome.err)[-4000:]
    )


def _moment(rng: np.random.Generator) -> float:
    """Share of the run, before it (negative: seconds after the start of the process) or a little behind its end."""
    return -float(rng.uniform(0.0, 1.5)) if rng.random() < 0.2 else float(rng.uniform(0.0, 1.2))


def _silent(outcome: Outcome, faults: list[str], killed: int | None = None) -> list[str]:
    """Faults of the runner: what no run may do, and an exit code that is not documented; `killed`: the signal that ended it."""
    found = [fault for fault in outcome.faults() if not (killed and fault.startswith("killed by"))]
    if outcome.code is not None and outcome.code not in DOCUMENTED and outcome.code != -(killed or 0):
        found.append(f"exit code {outcome.code}")
    return found + faults


def prepare_kill(folder: Path) -> Attempt:
    """kill -9 of the runner, the recorder or both."""
    warm_up(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        target = ("runner", "recorder", "both")[rng.integers(3)]
        moment = _moment(rng)
        bench = Bench(own, DURATION_S)
        bench.wait_until(moment)
        recorders = bench.recorders()
        for pid in recorders if target != "runner" else ():
            bench.send(signal.SIGKILL, pid)
        if target != "recorder":
            bench.send(signal.SIGKILL)
        outcome = bench.finish(recorders)
        words, faults = judge_log(bench.log, _PLANNED)
        if target == "recorder" and outcome.code == 0 and not words.startswith("report 0"):
            faults.append(f"silent pass of the run itself: its log says {words}")
        faults = _silent(outcome, faults, None if target == "recorder" else signal.SIGKILL)
        return _tried(f"kill of {target} at {moment:.2f}", target, outcome, faults, words)

    return attempt


def prepare_signal(folder: Path) -> Attempt:
    """SIGINT, SIGTERM, SIGHUP, once or several times, to runner or recorder."""
    warm_up(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        number = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)[rng.integers(3)]
        to_recorder, times, moment = rng.random() < 0.3, int(rng.choice([1, 1, 2, 5])), _moment(rng)
        bench = Bench(own, DURATION_S)
        bench.wait_until(moment)
        recorders = bench.recorders()
        for _ in range(times):
            for pid in recorders if to_recorder else [bench.pid]:
                bench.send(number, pid)
            time.sleep(float(rng.uniform(0, 0.05)))
        outcome = bench.finish(recorders or bench.recorders())
        words, faults = judge_log(bench.log, _PLANNED)
        group = f"{number.name} to {'recorder' if to_recorder else 'runner'}"
        return _tried(f"{times} x {group} at {moment:.2f}", group, outcome, _silent(outcome, faults, number), words)

    return attempt


def prepare_stall(folder: Path) -> Attempt:
    """SIGSTOP of 1 ms to 30 s, of runner, recorder or both, from before the first tick to behind the planned end."""
    warm_up(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        target = ("runner", "recorder", "both")[rng.integers(3)]
        moment, pause_s = _moment(rng), float(np.exp(rng.uniform(np.log(1e-3), np.log(30.0))))
        bench = Bench(own, DURATION_S)
        bench.wait_until(moment)
        recorders = bench.recorders()
        stopped = [bench.pid] * (target != "recorder") + recorders * (target != "runner")
        for pid in stopped:
            bench.send(signal.SIGSTOP, pid)
        time.sleep(pause_s)
        for pid in stopped:
            bench.send(signal.SIGCONT, pid)
        outcome = bench.finish(recorders or bench.recorders())
        words, faults = judge_log(bench.log, _PLANNED)
        if words.startswith("report") and target == "runner":
            faults += replayed(bench.log)
        if outcome.code == 0 and not words.startswith("report 0"):
            faults.append(f"silent pass of the run itself: its log says {words}")
        what = f"stop of {target} for {pause_s * 1e3:.0f} ms at {moment:.2f}"
        return _tried(what, target, outcome, _silent(outcome, faults), words)

    return attempt


def prepare_disk(folder: Path) -> Attempt:
    """A disk that is full at any size, a log that is deleted or cut while it is written, a folder that goes away."""
    warm_up(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        kind = ("full", "deleted", "cut", "folder gone")[rng.integers(4)]
        size = int(np.exp(rng.uniform(np.log(100), np.log(400_000))))
        place = own / "logs"
        place.mkdir()
        bench = _BenchIn(own, place, size if kind == "full" else None)
        if kind != "full":
            bench.wait_until(float(rng.uniform(0.0, 0.9)))
        recorders = bench.recorders()
        if kind == "deleted":
            bench.log.unlink(missing_ok=True)
        elif kind == "folder gone":
            place.rename(own / "elsewhere")
        elif kind == "cut" and bench.log.exists():
            os.truncate(bench.log, bench.log.stat().st_size // 2)
        outcome = bench.finish(recorders or bench.recorders())
        words, faults = judge_log(bench.log, _PLANNED)
        if kind == "cut":  # somebody did change bytes
            faults = [fault for fault in faults if "damaged" not in fault]
        if outcome.code == 0 and not words.startswith("report 0"):
            faults.append(f"silent pass of the run itself: its log says {words}")
        what = f"disk {kind}" + (f" at {size} bytes" if kind == "full" else "")
        return _tried(what, kind, outcome, _silent(outcome, faults), words)

    return attempt


class _BenchIn(Bench):
    """A run whose log stands in a folder of its own."""

    def __init__(self, folder: Path, place: Path, file_bytes_max: int | None) -> None:
        self._place = place
        super().__init__(folder, DURATION_S, file_bytes_max)

    @property
    def log(self) -> Path:
        return self._place / "run.mcap"

    @log.setter
    def log(self, _path: Path) -> None:
        """Where it is stands fast."""


_ERRNOS = (
    errno.EINTR,
    errno.EINVAL,
    errno.EIO,
    errno.ENOSPC,
    errno.EPERM,
    errno.ENOMEM,
    errno.EAGAIN,
    errno.ENXIO,
    errno.EBADF,
)


def prepare_syscall(folder: Path) -> Attempt:
    """The n-th call of each kind fails, once, three times or for good: calls of the loop and of the recorder."""
    warm_up(folder)
    library = failing_calls.build(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        of_loop = rng.random() < 0.5
        calls = (
            [call for call in failing_calls.LOOP_CALLS if "mmsg" not in call]
            if of_loop
            else failing_calls.RECORDER_CALLS
        )
        call, number = str(rng.choice(calls)), int(rng.choice(_ERRNOS))
        first, count = int(np.exp(rng.uniform(0.0, np.log(700.0)))), int(rng.choice([1, 3, -1]))
        process, thread = ("attacked.toml", "other") if of_loop else (failing_calls.RECORDER, "any")
        words = failing_calls.environment(library, call, number, first, count, process, thread)
        bench = Bench(own, DURATION_S, environment=words)
        bench.wait_until(0.0)
        outcome = bench.finish(bench.recorders())
        told, faults = judge_log(bench.log, _PLANNED)
        if outcome.code == 0 and not told.startswith("report 0"):
            faults.append(f"silent pass of the run itself: its log says {told}")
        group = f"{call} of the {'loop' if of_loop else 'recorder'}"
        what = (
            f"{group}: {errno.errorcode[number]} from call {first} on, {'for good' if count < 0 else f'{count} times'}"
        )
        return _tried(what, group, outcome, _silent(outcome, faults), told)

    return attempt


KILL = Campaign("kill", "kill -9 of runner, recorder or both at any moment", 120, prepare_kill)
SIGNAL = Campaign("signal", "SIGINT, SIGTERM, SIGHUP at any moment, to runner or recorder", 120, prepare_signal)
STALL = Campaign("stall", "SIGSTOP of 1 ms to 30 s, over start and end too", 100, prepare_stall)
DISK = Campaign("disk", "a disk that is full, a log deleted or cut, a folder gone", 120, prepare_disk)
SYSCALL = Campaign("syscall", "the n-th system call of loop or recorder fails", 120, prepare_syscall)
