"""The files a profile names: beside it, among what ships, or, for a profile out of a log, in that log and nowhere else."""

from pathlib import Path

from hilrunner.base.errors import ProfileError
from hilrunner.setup.profile import LoadedProfile, SealedFile


def find_file(loaded: LoadedProfile, name: str, shipped_folder: Path) -> Path:
    """A file named by a profile on disk: relative to it, by its bare name beside it, or among what ships.

    Raises ProfileError for a profile out of a log, which has no files on disk: see `sealed_file`.
    """
    if loaded.sealed is not None:
        raise _not_in_log(loaded, name)
    for candidate in (loaded.path.parent / name, loaded.path.parent / Path(name).name):
        if is_file(candidate):
            return candidate
    return shipped_folder / name


def sealed_file(loaded: LoadedProfile, name: str) -> SealedFile | None:
    """A file of a profile that came in a log; None for a profile on disk; ProfileError where the log does not hold it."""
    if loaded.sealed is None:
        return None
    # logs of earlier versions name models by their paths and hold them by their bare names
    found = loaded.sealed.get(name) or loaded.sealed.get(name.rsplit("/", 1)[-1])
    if found is None:
        raise _not_in_log(loaded, name)
    return found


def _not_in_log(loaded: LoadedProfile, name: str) -> ProfileError:
    return ProfileError(
        str(loaded.path),
        f"names '{name}', which the log does not hold, and what came in a log reads nothing else",
        ", ".join(loaded.sealed or ()),
        "run it again from the profile and its files",
    )


def is_file(path: Path) -> bool:
    """Whether a regular file is there; a name that no file system takes is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long for any file system
        return False
