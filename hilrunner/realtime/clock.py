"""The clock of the loop: CLOCK_MONOTONIC read, and absolute sleep with an optional spin tail.

Every function takes the `clock` array as its first argument, so that a test replaces the functions and keeps its simulated
time in the array: the loop itself never asks for the time anywhere else. Layout of `clock`, int64[10]:
0..1 `struct timespec` for the kernel, 2 spin tail in ns, 3 rate of the cycle counter (0: the kernel is asked each time),
4 free (a fake clock's own word), 5..6 the last moment the kernel was asked: ns and cycles, 7 the first system call that failed,
8..9 virtual time: whether it is, and its now.

No call here can fail on a sound host but by a signal (EINTR). One that does fail is noted in the last word: time stands still
from then on, no wait goes on, and the loop ends the run before another tick (docs/realtime.md).

Where a clock call costs microseconds (user-mode kernels have no vDSO) the kernel is asked once a period, at the wake-up, and
the cycle counter tells the rest of the period.
"""

import time

import numpy as np
from numba import types

from hilrunner.base.compiled import hot
from hilrunner.realtime import cycles
from hilrunner.realtime.socketcan import last_errno

CLOCK_REALTIME = 0
CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
EINTR = 4
CLOCK_WORD_COUNT = 10
WORD_SPIN_NS = 2
WORD_CYCLE_RATE = 3
WORD_FAKE = 4
WORD_ANCHOR_NS = 5
WORD_ANCHOR_CYCLES = 6
WORD_FAILURE = 7  # CALL_* << CALL_SHIFT | errno; 0: none
WORD_VIRTUAL = 8  # not 0: time is virtual, and the next word is the time
WORD_VIRTUAL_NOW = 9
CALL_SHIFT = 16
CALL_GETTIME = 1
CALL_NANOSLEEP = 2
CALL_NAMES = ("", "clock_gettime", "clock_nanosleep")
INTERRUPTS_MAX = 10_000  # of one sleep
DEAR_CLOCK_NS = 1_000  # from this cost of one clock call on, the cycle counter is used where it can be
_ANCHOR_CYCLES_MAX = 1 << 31

_pointer = types.CPointer(types.int64)
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, _pointer))
_clock_nanosleep = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, _pointer, types.voidptr)
)


def make_clock(spin_ns: int) -> np.ndarray:
    """The clock array of a real run; measures what a clock call costs here and whether the cycle counter can help."""
    clock = np.zeros(CLOCK_WORD_COUNT, np.int64)
    clock[WORD_SPIN_NS] = spin_ns
    if clock_call_ns() >= DEAR_CLOCK_NS:
        clock[WORD_CYCLE_RATE] = cycles.calibrate()
    return clock


def clock_call_ns() -> int:
    """What one clock call costs on this host, ns (the quickest of several)."""
    costs = []
    for _ in range(16):
        before_ns = time.monotonic_ns()
        costs.append(time.monotonic_ns() - before_ns)
    return min(costs)


@hot
def _kernel_ns(clock, which):
    """A clock of the kernel in ns; the last anchor when the call fails, which is noted."""
    if clock[WORD_VIRTUAL] != 0:
        return clock[WORD_VIRTUAL_NOW]
    if _clock_gettime(np.int32(which), clock.ctypes) != 0:
        _note_failure(clock, CALL_GETTIME, last_errno())
        return clock[WORD_ANCHOR_NS]
    return clock[0] * 1_000_000_000 + clock[1]


@hot
def _note_failure(clock, call, error):
    if clock[WORD_FAILURE] == 0:
        clock[WORD_FAILURE] = (np.int64(call) << CALL_SHIFT) | np.int64(error)


@hot
def anchor(clock):
    """Ask the kernel for CLOCK_MONOTONIC, ns, and remember the moment for the cycle counter; once a period."""
    now_ns = _kernel_ns(clock, CLOCK_MONOTONIC)
    clock[WORD_ANCHOR_NS] = now_ns
    if clock[WORD_CYCLE_RATE] != 0:
        clock[WORD_ANCHOR_CYCLES] = cycles.read_cycles()
    return now_ns


@hot
def now_mono_ns(clock):
    """CLOCK_MONOTONIC in ns: a vDSO call (about 30 ns), or the cycle counter since the last anchor where that is dear."""
    rate = clock[WORD_CYCLE_RATE]
    if rate != 0:
        passed = cycles.read_cycles() - clock[WORD_ANCHOR_CYCLES]
        if 0 <= passed < _ANCHOR_CYCLES_MAX:
            return clock[WORD_ANCHOR_NS] + (passed * rate >> cycles.SCALE_BITS)
        return anchor(clock)
    return _kernel_ns(clock, CLOCK_MONOTONIC)


@hot
def now_real_ns(clock):
    """CLOCK_REALTIME in ns, the clock of kernel receive stamps."""
    return _kernel_ns(clock, CLOCK_REALTIME)


@hot
def clock_offset_ns(clock):
    """CLOCK_REALTIME - CLOCK_MONOTONIC, ns: of three readings the one with the least time around it."""
    offset_ns = np.int64(0)
    shortest_ns = np.int64(1 << 62)
    for _ in range(3):
        before_ns = now_mono_ns(clock)
        real_ns = now_real_ns(clock)
        around_ns = now_mono_ns(clock) - before_ns
        if around_ns < shortest_ns:
            shortest_ns = around_ns
            offset_ns = real_ns - before_ns - (around_ns >> 1)
    return offset_ns


@hot
def wait_until(clock, deadline_mono_ns):
    """Sleep to an absolute point of CLOCK_MONOTONIC; with a spin tail, sleep short of it and spin the rest."""
    sleep_until(clock, deadline_mono_ns - clock[WORD_SPIN_NS])
    if clock[WORD_SPIN_NS] > 0:
        spin_until(clock, deadline_mono_ns)


@hot
def sleep_until(clock, wake_mono_ns):
    """Sleep to an absolute point of CLOCK_MONOTONIC; at once when it has passed.

    An interrupted sleep (EINTR) is taken up again until its time has come; absolute time needs no remainder. Any other failure, and
    a sleep that is interrupted for ever, is noted: the caller must not take the time for come.
    """
    error = EINTR
    interrupts = 0
    while error == EINTR and interrupts < INTERRUPTS_MAX:
        interrupts += 1
        clock[0] = wake_mono_ns // 1_000_000_000
        clock[1] = wake_mono_ns % 1_000_000_000
        error = _clock_nanosleep(np.int32(CLOCK_MONOTONIC), np.int32(TIMER_ABSTIME), clock.ctypes, 0)
        if error == EINTR and (now_mono_ns(clock) >= wake_mono_ns or clock[WORD_FAILURE] != 0):
            return
    if error != 0:
        _note_failure(clock, CALL_NANOSLEEP, error)


@hot
def spin_until(clock, deadline_mono_ns):
    """Read the clock until the deadline has come."""
    while now_mono_ns(clock) < deadline_mono_ns and clock[WORD_FAILURE] == 0:
        pass
