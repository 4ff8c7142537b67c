"""How this project compiles: one decorator for inner functions, one for cached ones, one cache folder a room and source state.

Numba's own cache looks only at the file of the cached function, not at what it calls. So a cached function is kept in a folder
named by a hash over every file it may call: its own room and the rooms below it. A change anywhere below makes a fresh
folder; a change above costs nothing. Numba keeps pickles, so each folder is ours alone (`own_folder`). Import this before numba.
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


def cache_folder(room: str = "realtime") -> Path:
    """Where compiled code of a room is kept, one subfolder a source state: of $NUMBA_CACHE_DIR, or of `cache_base`.

    Raises:
        FolderError: others could have put code there.
    """
    base = Path(os.environ["NUMBA_CACHE_DIR"]).absolute() if os.environ.get("NUMBA_CACHE_DIR") else cache_base()
    return own_folder(base / f"{room}-{source_hash(room)}")


import numba  # noqa: E402  (nothing of numba may be imported before the cache folder can be chosen)

# Inner functions: compiled into whoever calls them. No fast-math: a replay must give the same bits.
hot = numba.njit(nogil=True, error_model="numpy")
# Small inner functions called by the hundred thousand each second: a real call would save and restore every register.
inlined = numba.njit(nogil=True, error_model="numpy", forceinline=True)
_cached = numba.njit(nogil=True, error_model="numpy", cache=True)


def _in_cache_of(function, decorate):
    """Decorate with the cache folder of the function's room in force."""
    parts = function.__module__.split(".")
    room = parts[1] if len(parts) > 2 else "realtime"
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder(room))  # read when the decorator builds the function's cache
    try:
        return decorate(function)
    finally:
        numba.config.CACHE_DIR = before


def entry(function):
    """Compiled and kept on disk: functions called from Python, and large inner ones that several of those share.

    Module-level functions only: a closure over other compiled functions has no name to be found again by.
    """
    return _in_cache_of(function, _cached)


def callback(signature):
    """Compiled with a C calling convention and kept on disk: what a C library calls back; `.address` is its address."""
    as_c_function = numba.cfunc(signature, nopython=True, error_model="numpy", cache=True)
    return lambda function: _in_cache_of(function, as_c_function)
