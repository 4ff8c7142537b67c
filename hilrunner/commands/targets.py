"""Files a command writes: refused before any work where they cannot be written, and whole or absent afterwards.

A log is evidence: nothing takes its place unless --overwrite is given. Pages and figures are made from logs and can be made
again, so they replace those of an earlier call, but never a log.
"""

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from hilrunner.base.errors import LogError, UsageError
from hilrunner.record.file_lock import is_locked

_LOG_MAGIC = b"\x89MCAP0\r\n"


def check_targets(targets: Iterable[Path | None], log: Path | None = None) -> None:
    """Refuse targets that cannot be written, or under whose name a log lies; the folders above them are made.

    Args:
        targets: files; None is skipped.
        log: the command's input, never to be overwritten.

    Raises UsageError.
    """
    for path in targets:
        if path is not None:
            _check_name(path, log)
            if _is_log(path):
                raise UsageError(str(path), "is a log of a run and would be lost", remedy="name another file")
            _check_writable(path)


def check_new_log(path: Path | None, overwrite: bool, log: Path | None = None) -> None:
    """The same for a log to be written: any file that lies there is refused unless it is to be overwritten."""
    if path is not None:
        _check_name(path, log)
        if path.is_file() and not overwrite:
            raise _exists(path)
        _check_unlocked(path)
        _check_writable(path)


def claim_log(path: Path, overwrite: bool) -> bool:
    """Take the name of a log before the start of a run: an empty file, so that no other run can take it too.

    Returns True when the file is new; False where an old one is to be overwritten (or refused by the recorder).
    Raises UsageError when it exists and is not to be overwritten, LogError when it cannot be made or is a folder.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644))
    except FileExistsError:
        if path.is_dir():  # told now, not after a bench has been compiled and warmed up
            raise LogError(str(path), "is a directory", remedy="choose another --log or --no-log") from None
        if path.is_file() and not overwrite:
            raise _exists(path) from None
        _check_unlocked(path)
        return False
    except OSError as error:
        raise LogError(
            str(path), f"the log cannot be created: {error.strerror}", remedy="choose another --log or --no-log"
        ) from None
    return True


def claim_free_log(folder: Path, name: str) -> Path:
    """The first free one of NAME.mcap, NAME-2.mcap, …: two benches may start in the same second."""
    for number in itertools.count(1):
        path = folder / (f"{name}.mcap" if number == 1 else f"{name}-{number}.mcap")
        if not os.path.lexists(path) and claim_log(path, overwrite=True):
            return path
    raise AssertionError("unreachable")


def check_folder(folder: Path) -> None:
    """Make a folder that files will be written to; UsageError when that, or writing there, is impossible."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(str(folder), "is not a folder", remedy="name a folder")
    check_targets([folder / "probe"])


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write the contents of `path`: they take its place at the end, and vanish when the writing fails or is interrupted."""
    if _is_special(path):  # a pipe or a device has no place to take
        yield path
        return
    part = _part(path)
    try:
        yield part
        os.replace(part, path.resolve())
    except LogError as error:
        raise LogError(str(path), error.problem, error.limit, error.remedy) from None
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a file and the folders above it; UsageError when that cannot be done."""
    with _refused(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as part:
            part.write_text(text, encoding="utf-8")
    return path


def _check_name(path: Path, log: Path | None) -> None:
    if path.is_dir():
        raise UsageError(str(path), "is a folder", remedy="name a file")
    if log is not None and path.exists() and log.exists() and path.samefile(log):
        raise UsageError(str(path), "is the log that is read", remedy="name another file")


def _check_writable(path: Path) -> None:
    if _is_special(path):
        return
    with _refused(path):
        path.resolve().parent.mkdir(parents=True, exist_ok=True)
        probe = _part(path)
        probe.touch()
        probe.unlink()


def _check_unlocked(path: Path) -> None:
    if path.is_file() and is_locked(path):
        raise UsageError(str(path), "a run is writing this log now", remedy="name another file, or end that run")


def _exists(path: Path) -> UsageError:
    return UsageError(
        str(path),
        f"exists already ({path.stat().st_size} bytes), and a log is never overwritten unasked",
        remedy="name another file, or add --overwrite",
    )


def _is_log(path: Path) -> bool:
    if not path.is_file():
        return False
    with contextlib.suppress(OSError), open(path, "rb") as file:
        return file.read(len(_LOG_MAGIC)) == _LOG_MAGIC
    return False


def _is_special(path: Path) -> bool:
    return path.exists() and not path.is_file()


def _part(path: Path) -> Path:
    """Beside the target itself, so that taking its place is one step; the ending is kept, writers choose the format by it."""
    target = path.resolve()
    return target.with_name(f".{os.getpid()}-part-{target.name}")


@contextlib.contextmanager
def _refused(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UsageError(
            str(path), f"cannot be written: {error.strerror or error}", remedy="name another file"
        ) from None
