"""Folders that code is loaded from: ours alone, or refused. What others can write there would run with our rights.

Compiled functions are kept by numba as pickles, the labs and the tests load shared objects that they built, and a kernel is booted
from a file. Each of these lies in a folder that `own_folder` has made or looked at. Python standard library only.
"""

import os
import stat
from functools import cache
from pathlib import Path

from hilrunner.base.errors import FolderError

LAB_USER_VARIABLE = "HILRUNNER_LAB_USER"  # set by the lab: the number of the user who started it
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_PRIVATE = 0o700


def cache_base() -> Path:
    """Where everything is kept that can be made again: $HILRUNNER_CACHE or the user's cache folder; absolute, not made here."""
    named = os.environ.get("HILRUNNER_CACHE")
    if named:
        return Path(named).absolute()
    kept = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(kept).absolute() / "hilrunner"


@cache
def own_folder(path: Path) -> Path:
    """The folder, made if it is not there, once it is certain that nobody else could have put a file into it.

    Certain means: it belongs to the user this process runs as, nobody else may write into it, every folder above it belongs to
    that user or to root and lets nobody else rename what is in it (a sticky folder such as /tmp does not), and so do the folders
    that links on the way lead through. A folder of ours that others could only read is closed to them, after a look at all that is in it.
    In a group of which the user is the only member nobody else is meant.

    Returns:
        The real path, without links.

    Raises:
        FolderError: it cannot be made or written, or others could have put code there.
    """
    try:
        missing = [one for one in (path, *path.parents) if not os.path.lexists(one)]
        if missing:
            _check_way(path, missing[-1].parent)  # nothing is made where others could exchange it
        for one in reversed(missing):
            one.mkdir(mode=_PRIVATE, exist_ok=True)
        real = path.resolve(strict=True)
        _check_way(path, path, real)
        _check_folder(path, real)
    except OSError as error:
        raise FolderError(_place(path), f"cannot be made: {error.strerror}", remedy=_ELSEWHERE) from None
    return real


_ELSEWHERE = "name a folder of your own in HILRUNNER_CACHE"


def _place(path: Path) -> str:
    return f"{path} (code is kept there and loaded from there)"


def _check_way(path: Path, place: Path, leaf: Path | None = None) -> None:
    """Nobody else can exchange a folder or a link on the way from the root to a place, the leaf left out."""
    waiting, seen = [place, place.resolve(strict=True)], {leaf}
    while waiting:
        step = waiting.pop()
        for above in (step, *step.parents):
            if above in seen:
                continue
            seen.add(above)
            state = os.lstat(above)
            if state.st_uid not in {0} | _us():
                _refuse(path, f"{above} belongs to {_user(state.st_uid)}")
            if stat.S_ISLNK(state.st_mode):
                waiting.append(above.parent / os.readlink(above))
            elif _others_write(state) and not state.st_mode & stat.S_ISVTX:
                _refuse(path, f"others may exchange what is in {above} (mode {stat.S_IMODE(state.st_mode):04o})")


def _check_folder(path: Path, real: Path) -> None:
    """The folder itself: ours, and closed to others from now on."""
    state = os.lstat(real)
    if not stat.S_ISDIR(state.st_mode):
        raise FolderError(_place(path), "is not a folder", remedy=_ELSEWHERE)
    if state.st_uid not in _us():
        _refuse(path, f"it belongs to {_user(state.st_uid)}", f"a folder of {_user(os.geteuid())}")
    if _others_write(state):
        _refuse(path, f"others may write into it (mode {stat.S_IMODE(state.st_mode):04o})")
    if not os.access(real, os.W_OK | os.X_OK):
        raise FolderError(_place(path), "cannot be written", remedy=_ELSEWHERE)
    if stat.S_IMODE(state.st_mode) != _PRIVATE:
        _check_inside(path, real)
        os.chmod(real, _PRIVATE)


def _check_inside(path: Path, real: Path) -> None:
    """Nothing in a folder that others could enter until now is theirs, or theirs to write."""
    for folder, folders, files in os.walk(real):
        for name in (*folders, *files):
            inside = os.path.join(folder, name)
            state = os.lstat(inside)
            if state.st_uid not in _us():
                _refuse(path, f"{inside} belongs to {_user(state.st_uid)}")
            if stat.S_ISLNK(state.st_mode):
                _refuse(path, f"{inside} is a link")
            if _others_write(state):
                _refuse(path, f"others may write {inside} (mode {stat.S_IMODE(state.st_mode):04o})")


@cache
def _us() -> frozenset[int]:
    """Users that are this one: root of a User-Mode Linux lab has the files and the rights of the user who started it."""
    users = {os.geteuid()}
    outside = os.environ.get(LAB_USER_VARIABLE, "")
    if outside.isdecimal() and os.geteuid() == 0 and "User Mode Linux" in Path("/proc/cpuinfo").read_text():
        users.add(int(outside))
    return frozenset(users)


def _others_write(state: os.stat_result) -> bool:
    writers = state.st_mode & _OTHERS_WRITE
    return bool(writers & stat.S_IWOTH or (writers and not _is_private_group(state.st_gid)))


@cache
def _is_private_group(group_id: int) -> bool:
    """True for a group whose only member is this user, or root: where each user has one, files are group-writable by habit."""
    import grp
    import pwd

    try:
        group, user = grp.getgrgid(group_id), pwd.getpwuid(os.geteuid())
    except KeyError:
        return False
    own = group_id == 0 or (group.gr_name == user.pw_name and user.pw_gid == group_id)
    return own and set(group.gr_mem) <= {user.pw_name, "root"}


def _user(user_id: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return f"user {user_id}"


def _refuse(path: Path, problem: str, limit: str = "written by nobody but you and root") -> None:
    raise FolderError(
        _place(path),
        f"{problem}: somebody else could have put code there",
        limit=limit,
        remedy=f"remove it (it is made again) and keep others from writing there, or {_ELSEWHERE}",
    )
