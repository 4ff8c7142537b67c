"""Errors a user sees: one sentence that names the place, the value, the limit and the remedy, and an exit code."""

from hilrunner.base import exit_codes
from hilrunner.base.plain_text import plain_line


class HilrunnerError(Exception):
    """A refusal with everything a user needs to mend it, in one line, whatever names and texts of files are part of it.

    Args:
        place: what is wrong and where (`profiles/x.toml: axis[0].load.mass_kg`).
        problem: the value found and why it is refused, with units.
        limit: what would be accepted; empty if the problem says it.
        remedy: what to do.
    """

    exit_code = exit_codes.BAD_INPUT

    def __init__(self, place: str, problem: str, limit: str = "", remedy: str = "") -> None:
        self.place = plain_line(place)
        self.problem = plain_line(problem)
        self.limit = plain_line(limit)
        self.remedy = plain_line(remedy)
        parts = [f"{self.place}: {self.problem}"]
        if limit:
            parts.append(f"allowed: {self.limit}")
        if remedy:
            parts.append(f"remedy: {self.remedy}")
        super().__init__("; ".join(parts))


class UsageError(HilrunnerError):
    """A command line that cannot be carried out."""


class ProfileError(HilrunnerError):
    """A profile with an unknown key, a wrong unit, an impossible value or relation."""


class ModelError(HilrunnerError):
    """A trained model that is missing, damaged, foreign or disagrees with onnxruntime."""


class DbcError(HilrunnerError):
    """A DBC that lacks a message or signal the profile maps, or cannot carry a quantity."""


class LogError(HilrunnerError):
    """A log that cannot be read or written."""


class FolderError(HilrunnerError):
    """A folder that code would be loaded from and that cannot be made, or that others could have put code into."""


class StateError(HilrunnerError):
    """No consistent initial state exists for what was asked."""


class CanError(HilrunnerError):
    """The bus is missing, down, or was lost during the run."""

    exit_code = exit_codes.CAN_LOST


class RealtimeRefusedError(HilrunnerError):
    """--require-realtime was given and the host refused part of it."""

    exit_code = exit_codes.REALTIME_REFUSED
