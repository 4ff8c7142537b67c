"""The last net under every command: what nobody foresaw ends in one line with place and remedy, never in a raw traceback."""

import os
import sys
import traceback

from hilrunner.base import exit_codes
from hilrunner.base.plain_text import plain_line

TRACEBACK_VARIABLE = "HILRUNNER_TRACEBACK"
_PACKAGE = "hilrunner"
_REMEDY = f"run it again with {TRACEBACK_VARIABLE}=1, which shows the whole trace, and report that"


def told(error: Exception, command: str) -> int:
    """Print one line on stderr about an exception that no command turned into a refusal; returns the exit code.

    With HILRUNNER_TRACEBACK set, Python's own traceback comes before it.
    """
    if os.environ.get(TRACEBACK_VARIABLE):
        traceback.print_exception(error)
    print(f"hilrunner {command}: {plain_line(sentence(error))}", file=sys.stderr)
    return exit_codes.BAD_INPUT


def sentence(error: Exception) -> str:
    """What happened, where in the program, and what to do."""
    words = str(error).strip() or "no further word"
    if isinstance(error, ModuleNotFoundError) and error.name:
        package = error.name.partition(".")[0]
        return f"the package {package} is not installed ({_where(error)}); remedy: install hilrunner again with what it needs, or pip install {package}"
    if isinstance(error, OSError) and error.strerror:
        names = ", ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
        words = f"{names}: {error.strerror}" if names else error.strerror
        kind = "the system refused"
    elif isinstance(error, RecursionError):
        words, kind = "the input is nested too deeply", "an error that was not foreseen"
    else:
        kind = f"an error that was not foreseen, {type(error).__name__}"
    return f"{kind}: {words} ({_where(error)}); remedy: {_REMEDY}"


def _where(error: Exception) -> str:
    """The innermost place in this package, and the library beneath it that raised, where one did."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [index for index, frame in enumerate(frames) if _is_ours(frame.filename)]
    if not ours:
        return "before the command began"
    frame = frames[ours[-1]]
    place = f"in {frame.name}, {_short(frame.filename)} line {frame.lineno}"
    return place if ours[-1] == len(frames) - 1 else f"{place}, calling {_short(frames[-1].filename)}"


def _is_ours(filename: str) -> bool:
    return _short(filename).startswith(f"{_PACKAGE}/")


def _short(filename: str) -> str:
    """A file without the folders above its package."""
    for mark in (f"{os.sep}site-packages{os.sep}", f"{os.sep}{_PACKAGE}{os.sep}"):
        if mark in filename:
            kept = filename.rpartition(mark)[2]
            return kept if "site-packages" in mark else f"{_PACKAGE}/{kept}"
    return os.path.basename(filename)
