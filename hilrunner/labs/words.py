"""What all labs share: how they speak, their exit codes, how they say that they cannot start, how a command is run and ended."""

import os
import re
import shutil
import signal
import subprocess
import sys

from hilrunner.labs.guest import EXIT_CANNOT_RUN, EXIT_NO_LAB, EXIT_NOT_FOUND, SYSTEM_PATH

__all__ = ["EXIT_CANNOT_RUN", "EXIT_NOT_FOUND", "EXIT_NO_LAB", "EXIT_TIMEOUT", "SYSTEM_PATH"]

EXIT_TIMEOUT = 124
REASON_LENGTH_MAX = 200


class CannotStart(Exception):  # noqa: N818  (no error: the next lab is tried)
    """A lab that cannot give a bus here; its text is one line that says why."""

    def __init__(self, reason: str, packages: list[str] | None = None) -> None:
        super().__init__(one_line(reason))
        self.packages = packages or []  # Debian packages with which it could


def one_line(text: str) -> str:
    """A text of others as one line without control characters."""
    words = re.sub(r"[\x00-\x1f\x7f-\x9f\s]+", " ", text).strip()
    return words if len(words) <= REASON_LENGTH_MAX else words[: REASON_LENGTH_MAX - 1] + "…"


def say(text: str) -> None:
    """One line about the lab on standard error; the command's own output stays clean."""
    print(f"lab: {text}", file=sys.stderr, flush=True)


def which(program: str) -> str | None:
    """Find a program also where users without root do not look (/usr/sbin)."""
    return shutil.which(program, path=os.environ.get("PATH", "") + ":" + SYSTEM_PATH)


def missing_packages(packages: dict[str, str]) -> list[str]:
    """Of a table program → Debian package: the packages whose program is not here, each once."""
    return list(dict.fromkeys(package for program, package in packages.items() if which(program) is None))


def end_group(child: subprocess.Popen) -> None:
    """SIGTERM to the group, SIGKILL to what is left after five seconds."""
    for number, wait_s in ((signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0)):
        try:
            os.killpg(child.pid, number)
            child.wait(wait_s)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            continue
