"""The clock of the loop: CLOCK_MONOTONIC read, and absolute sleep with an optional spin tail.

Every function takes the `clock` array as its first argument, so that a test replaces the functions and keeps its simulated
time in the array: the loop itself never asks for the time anywhere else. Layout of `clock`, int64[8]:
0..1 `struct timespec` for the kernel, 2 spin tail in ns, 3.. free (a fake clock's own words).
"""

import numpy as np
from numba import types

from hilrunner.base.compiled import hot

CLOCK_REALTIME = 0
CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
CLOCK_WORD_COUNT = 8
WORD_SPIN_NS = 2

_pointer = types.CPointer(types.int64)
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, _pointer))
_clock_nanosleep = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, _pointer, types.voidptr)
)


def make_clock(spin_ns: int) -> np.ndarray:
    """The clock array of a real run."""
    clock = np.zeros(CLOCK_WORD_COUNT, np.int64)
    clock[WORD_SPIN_NS] = spin_ns
    return clock


@hot
def now_mono_ns(clock):
    """CLOCK_MONOTONIC in ns; a vDSO call, about 30 ns where the kernel has one."""
    _clock_gettime(np.int32(CLOCK_MONOTONIC), clock.ctypes)
    return clock[0] * 1_000_000_000 + clock[1]


@hot
def now_real_ns(clock):
    """CLOCK_REALTIME in ns, the clock of kernel receive stamps."""
    _clock_gettime(np.int32(CLOCK_REALTIME), clock.ctypes)
    return clock[0] * 1_000_000_000 + clock[1]


@hot
def wait_until(clock, deadline_mono_ns):
    """Sleep to an absolute point of CLOCK_MONOTONIC; with a spin tail, sleep short of it and spin the rest.

    An interrupted sleep (EINTR) returns early and the loop's own time stamp shows it; absolute time needs no remainder.
    """
    spin_ns = clock[WORD_SPIN_NS]
    sleep_to_ns = deadline_mono_ns - spin_ns
    clock[0] = sleep_to_ns // 1_000_000_000
    clock[1] = sleep_to_ns % 1_000_000_000
    while _clock_nanosleep(np.int32(CLOCK_MONOTONIC), np.int32(TIMER_ABSTIME), clock.ctypes, 0) == 4:  # EINTR
        clock[0] = sleep_to_ns // 1_000_000_000
        clock[1] = sleep_to_ns % 1_000_000_000
    if spin_ns > 0:
        while now_mono_ns(clock) < deadline_mono_ns:
            pass
