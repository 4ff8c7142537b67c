"""Who writes a log holds a lock on it, so that no second run takes its place: advisory, released by the system at the holder's end."""

import errno
import fcntl
import os
from pathlib import Path

_HELD_ERRNOS = {errno.EAGAIN, errno.EACCES}


def take_lock(fd: int) -> bool:
    """Lock an open file until it is closed; False when somebody else holds it.

    A file system without locks (errno ENOLCK, EOPNOTSUPP, …) lets everybody through.
    """
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _HELD_ERRNOS
    return True


def is_locked(path: Path) -> bool:
    """Whether somebody writes the log of this name now."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not take_lock(fd)
    finally:
        os.close(fd)
