"""The words of host inspection: a finding, a grant, and the one reader of /proc and /sys (so that tests bring their own)."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

OK, WARN, FAIL = "ok", "warn", "fail"
VERDICTS = (OK, WARN, FAIL)


@dataclass(frozen=True)
class Finding:
    """One fact about the host that matters for timing.

    Args:
        name: what was looked at. value: what was found, with unit.
        verdict: ok; warn (real time may still hold, and this is where to look first); fail (it cannot be trusted).
        remedy: what to do; empty if ok.
    """

    name: str
    value: str
    verdict: str
    remedy: str = ""

    def as_dict(self) -> dict[str, str]:
        """The finding for JSON and for the log's metadata."""
        return {"name": self.name, "value": self.value, "verdict": self.verdict, "remedy": self.remedy}


@dataclass(frozen=True)
class Grant:
    """One right that was asked of the kernel.

    Args:
        name: which right. asked, got: in words, with unit. granted: got what was asked.
        required: without it a run is not real time, however the host is set up.
        reason: why it was refused; empty if granted. remedy: how to be granted it.
        undo: gives it back (`leave_realtime`).
    """

    name: str
    asked: str
    got: str
    granted: bool
    required: bool = True
    reason: str = ""
    remedy: str = ""
    undo: Callable[[], None] | None = field(default=None, repr=False, compare=False)

    def as_dict(self) -> dict[str, str | bool]:
        """The grant for JSON and for the log's metadata."""
        return {
            "name": self.name,
            "asked": self.asked,
            "got": self.got,
            "granted": self.granted,
            "reason": self.reason,
            "remedy": self.remedy,
        }


@dataclass(frozen=True)
class HostFiles:
    """Reads the kernel's files below `root`; a missing or unreadable file is None, never an error."""

    root: Path = Path("/")

    def text(self, name: str) -> str | None:
        """The stripped text of one file, or None."""
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return (self.root / name).read_text().strip()
        return None

    def number(self, name: str) -> int | None:
        """One whole number, or None."""
        with contextlib.suppress(ValueError):
            return int(self.text(name) or "")
        return None

    def names(self, pattern: str) -> list[str]:
        """Paths below the root that match a glob, sorted, relative to the root."""
        with contextlib.suppress(OSError):
            return sorted(str(path.relative_to(self.root)) for path in self.root.glob(pattern))
        return []


def parse_cpu_list(text: str | None) -> set[int]:
    """The kernel's list of cores ("0-2,5") as a set; empty text is the empty set."""
    cores: set[int] = set()
    for part in (text or "").replace("\n", "").split(","):
        first, _, last = part.strip().partition("-")
        if first.isdigit() and (last.isdigit() or not last):
            cores.update(range(int(first), int(last or first) + 1))
    return cores
