"""Where compiled code is kept: one folder a room and source state. Known without numba, so that a command can tell early what it must compile.

Numba's own cache looks only at the file of the cached function, not at what it calls. So a cached function is kept in a folder
named by a hash over every file it may call: its own room and the rooms below it. A change anywhere below makes a fresh
folder; a change above costs nothing. Numba keeps pickles, so each folder is ours alone (`own_folder`).
"""

import hashlib
import os
from functools import cache
from pathlib import Path

from hilrunner.base.own_folder import cache_base, own_folder

_COMPILED_ROOMS = ("base", "plant", "realtime")  # lowest first; each may call those before it
_ROOT = Path(__file__).resolve().parent.parent


@cache
def _room_digest(room: str) -> bytes:
    digest = hashlib.sha256()
    for path in sorted((_ROOT / room).glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.digest()


def source_hash(room: str = "realtime") -> str:
    """Hash of every source file that code of this room may be compiled from."""
    rooms = [room]
    below = _COMPILED_ROOMS
    if room in _COMPILED_ROOMS:
        below = _COMPILED_ROOMS[: _COMPILED_ROOMS.index(room)]
    rooms.extend(below)
    return hashlib.sha256(b"".join(_room_digest(name) for name in rooms)).hexdigest()[:16]


def cache_place(room: str = "realtime") -> Path:
    """Path of a room's folder, which may not exist: in $NUMBA_CACHE_DIR, or in `cache_base`."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(named).absolute() if named else cache_base()
    return base / f"{room}-{source_hash(room)}"


def cache_folder(room: str = "realtime") -> Path:
    """The folder itself, made if need be.

    Raises:
        FolderError: others could have put code there.
    """
    return own_folder(cache_place(room))


def loop_is_compiled() -> bool:
    """True if something of the loop is kept for this source state; what is kept for another processor counts as well."""
    place = cache_place("realtime")
    return place.is_dir() and any(place.glob("*/*.nbi"))
