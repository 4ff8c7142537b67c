"""How this project compiles: one decorator for inner functions, one for cached ones, kept where `compiled_cache` says.

Import this before numba. What is compiled is told to the observers of `compile_watch`.
"""

from hilrunner.base.compile_watch import defined_names, name_of, observers
from hilrunner.base.compiled_cache import cache_folder, source_hash

__all__ = ["cache_folder", "callback", "entry", "folded", "hot", "inlined", "source_hash"]

import numba  # nothing of it may be imported before the cache folder can be chosen
from numba.core import event


def _defining(decorate):
    """The decorator, noting what it is given."""

    def define(function):
        defined_names.add(name_of(function))
        return decorate(function)

    return define


# Inner functions: compiled into whoever calls them. No fast-math: a replay must give the same bits.
hot = _defining(numba.njit(nogil=True, error_model="numpy"))
# Small inner functions called by the hundred thousand each second: a real call would save and restore every register.
inlined = _defining(numba.njit(nogil=True, error_model="numpy", forceinline=True))
# Inner functions with one caller, and a large one: taken into it before anything is compiled. Compiled by itself each of them would be
# optimised and turned into machine code together with all that it calls, only to be thrown away: seconds of a cold start.
folded = _defining(numba.njit(nogil=True, error_model="numpy", inline="always"))
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
    return _in_cache_of(function, _defining(_cached))


def callback(signature):
    """Compiled with a C calling convention and kept on disk: what a C library calls back; `.address` is its address."""
    as_c_function = numba.cfunc(signature, nopython=True, error_model="numpy", cache=True)
    return lambda function: _in_cache_of(function, as_c_function)


class _Listener(event.Listener):
    """Passes on what numba tells, as far as it is about our functions."""

    def on_start(self, event) -> None:
        self._tell(event, True)

    def on_end(self, event) -> None:
        self._tell(event, False)

    def _tell(self, event, begins: bool) -> None:
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("hilrunner."):
            for observer in observers:
                observer(name_of(function), begins)


event.register("numba:compile", _Listener())
