"""Programs whose system calls fail: builds `failing_calls.c`, and says how to start a program with it.

    library = failing_calls.build(folder)
    subprocess.run(command, env={**os.environ, **failing_calls.environment(library, "recvmmsg", errno.EINTR, first=200)})

The library is code, so it is built into a folder that nobody else can write; `build` refuses any other.
"""

import os
import stat
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("failing_calls.c")
LOOP_CALLS = ("clock_gettime", "clock_nanosleep", "recvmmsg", "sendmmsg", "getrusage", "sched_getcpu", "pread")
RECORDER_CALLS = ("write", "fallocate", "ftruncate64", "lseek64", "poll", "close")
DISK_WRITE = "disk_write"  # `write` to a file; pipes go on
RECORDER = "hilrunner.record"  # what the recorder's command line contains


def build(folder: Path) -> Path:
    """The library, compiled into `folder`, which must be ours and closed to others; PermissionError otherwise."""
    found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o022:
        raise PermissionError(f"{folder}: not a folder that only this user can write: make it with tempfile.mkdtemp")
    library = folder / "failing_calls.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(SOURCE), "-ldl"], check=True)
    return library


def environment(
    library: Path,
    call: str,
    errno: int,
    first: int = 1,
    count: int = -1,
    process: str = "",
    thread: str = "any",
    report: Path | None = None,
    once: Path | None = None,
) -> dict[str, str]:
    """Environment variables that let calls of a program fail.

    Args:
        call: one of LOOP_CALLS or RECORDER_CALLS, or DISK_WRITE. errno: what they fail with. first: the first call that fails, from 1.
        count: how many fail from there on, -1: all. process: text of the command line of the process meant; empty: all.
        once: calls count from when a file lies there, so that a test says when; None: from the start of the process.
        thread: "any", "main" or "other". report: a file that gets a line `call counted failed` from each process at its end.
    """
    return {
        "LD_PRELOAD": str(library),
        "FAILING_CALL": call,
        "FAILING_FROM": str(first),
        "FAILING_COUNT": str(count),
        "FAILING_ERRNO": str(errno),
        "FAILING_IN": process,
        "FAILING_THREAD": thread,
        "FAILING_ONCE": str(once) if once else "",
        "FAILING_REPORT": str(report) if report else "",
    }
