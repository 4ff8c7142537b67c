"""One command of hilrunner run to its end in a child made by `fork`, watched: exit code, words, time, memory.

The parent has loaded the compiled code, so a case costs milliseconds and not the second and a half of a new process. Nothing
a case does (memory, files it opened, signals) outlives its child.
"""

import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from tests.tools.error_lines import error_lines

HANG_S = 60.0
MEMORY_BYTES_MAX = 1_000_000_000
FRESH_BYTES = 150_000_000  # of a process that has loaded NumPy, Numba and the compiled code
_ADDRESS_SPARE_BYTES = 3 << 30  # beyond what the parent has: an allocation without end fails before the host suffers
_TRACEBACK = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Outcome:
    """What one command did. `code` is negative for a signal, None where it hung (HANG_S)."""

    code: int | None
    out: str
    err: str
    wall_s: float
    memory_bytes: int

    def faults(self) -> list[str]:
        """What no input may ever cause."""
        found = []
        if self.code is None:
            found.append(f"hang of more than {HANG_S:.0f} s")
        elif self.code < 0:
            found.append(f"killed by {signal.Signals(-self.code).name}")
        if _TRACEBACK in self.err or _TRACEBACK in self.out:
            found.append("traceback")
        if self.memory_bytes > MEMORY_BYTES_MAX:
            found.append(f"{self.memory_bytes / 1e6:.0f} MB of memory")
        harmful = [c for c in self.out + self.err if (c < " " and c not in "\n\t") or "\x7f" <= c <= "\x9f"]
        if harmful:
            found.append(f"control characters on the terminal: {sorted(set(harmful))!r}")
        if self.code == 2 and len(error_lines(self.err)) != 1:
            found.append("a refusal that is not one line")
        return found


def call(words: list[str], hang_s: float = HANG_S) -> Outcome:
    """`hilrunner WORDS` in a forked child."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        sys.stderr.flush()
        begin_s, own_bytes = time.monotonic(), _pages("resident")
        child = os.fork()
        if child == 0:
            _be_the_command(words, out.fileno(), err.fileno())
        code, memory_bytes = _wait(child, hang_s)
        # a child begins with the parent's pages, which may have compiled much; a process of its own begins with FRESH_BYTES
        memory_bytes = max(memory_bytes - own_bytes, 0) + FRESH_BYTES
        return Outcome(code, _text(out), _text(err), time.monotonic() - begin_s, memory_bytes)


def _be_the_command(words: list[str], out: int, err: int) -> None:
    code = 70
    try:
        os.setpgid(0, 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        spare = _pages("size") + _ADDRESS_SPARE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (spare, spare))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        from hilrunner import cli

        try:
            code = cli.main(words)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _wait(child: int, hang_s: float) -> tuple[int | None, int]:
    """A hang is that much processor time, or as long without any: on a busy machine a second of work can take a minute."""
    pause_s, used_s, moved_s = 0.0005, 0.0, time.monotonic()
    while True:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), used.ru_maxrss * 1024
        now_s, processor_s = time.monotonic(), _processor_s(child)
        if processor_s > used_s:
            used_s, moved_s = processor_s, now_s
        if used_s > hang_s or now_s - moved_s > hang_s:
            os.killpg(child, signal.SIGKILL)
            _, _, used = os.wait4(child, 0)
            return None, used.ru_maxrss * 1024
        time.sleep(pause_s)
        pause_s = min(pause_s * 1.5, 0.02)


def _processor_s(pid: int) -> float:
    """User and system time of a process so far; its clock ticks every 10 ms."""
    words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _pages(kind: str) -> int:
    """Bytes of address space (`size`) or of memory (`resident`) of this process."""
    words = Path("/proc/self/statm").read_text().split()
    return int(words[("size", "resident").index(kind)]) * resource.getpagesize()


def _text(file) -> str:
    file.seek(0)
    return file.read().decode("utf-8", "replace")
