"""How this project compiles: one decorator for inner functions, one for cached entry points, one cache folder a source state.

Numba's own cache looks only at the file of the cached function, not at what it calls; so the cache folder is named by a
hash over all compiled rooms, and a change anywhere makes a fresh one. Import this before numba.
"""

import hashlib
import os
from pathlib import Path

_ROOMS = ("base", "plant", "realtime")


def source_hash() -> str:
    """Hash of every source file of the compiled rooms."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for room in _ROOMS:
        for path in sorted((root / room).glob("*.py")):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where compiled entry points are kept: $HILRUNNER_CACHE or the user's cache folder, one subfolder a source state."""
    base = os.environ.get("HILRUNNER_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache"), "hilrunner"
    )
    return Path(base) / source_hash()


os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))

from numba import njit  # noqa: E402  (the cache folder must be set first)

# Inner functions: compiled into whoever calls them. No fast-math: a replay must give the same bits.
hot = njit(nogil=True, error_model="numpy")
# Entry points called from Python: cached on disk with everything they call.
entry = njit(nogil=True, error_model="numpy", cache=True)
