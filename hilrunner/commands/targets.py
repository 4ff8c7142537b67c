"""Files a command writes: refused before any work where they cannot be written, and whole or absent afterwards."""

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from hilrunner.base.errors import LogError, UsageError


def check_targets(targets: Iterable[Path | None], log: Path | None = None) -> None:
    """Refuse targets that cannot be written, or that are the log that is read; the folders above them are made.

    Args:
        targets: files; None is skipped.
        log: the command's input, never to be overwritten.

    Raises UsageError.
    """
    for path in targets:
        if path is None:
            continue
        if path.is_dir():
            raise UsageError(str(path), "is a folder", remedy="name a file")
        if log is not None and path.exists() and log.exists() and path.samefile(log):
            raise UsageError(str(path), "is the log that is read", remedy="name another file")
        if _is_special(path):
            continue
        with _refused(path):
            path.resolve().parent.mkdir(parents=True, exist_ok=True)
            probe = _part(path)
            probe.touch()
            probe.unlink()


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
