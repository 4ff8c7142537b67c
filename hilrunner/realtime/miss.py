"""Why was this tick late? What the kernel says about the loop's own thread, and the cause that explains the most.

`read_usage` is cheap enough for every tick (about 0.5 us, with the run-queue delay about 1.8 us), because a cause is a
*difference* between two ticks: counters read only after a miss cannot tell this miss from the last hour.

The run-queue delay (/proc/thread-self/schedstat, second number: ns the thread was runnable but did not run) is what
tells a competing task from a late timer: a FIFO task that runs while the loop sleeps raises no involuntary switch.
"""

import ctypes
import os

import numba
import numpy as np
from numba import types

from hilrunner.base.compiled import hot
from hilrunner.base.records import PHASE_WAKE
from hilrunner.base.status import (
    CAUSE_CARRIED_OVER,
    CAUSE_FRAME_BURST,
    CAUSE_LATE_WAKE,
    CAUSE_MIGRATED,
    CAUSE_PAGE_FAULT,
    CAUSE_PREEMPTED,
    CAUSE_RECORDER,
    CAUSE_SEND,
    CAUSE_STEP,
    CAUSE_UNKNOWN,
    PHASE_COUNT,
    PHASE_ENCODE,
    PHASE_RECORD,
    PHASE_STEP,
)

# one reading of the thread's counters, int64[USAGE_SIZE]
USAGE_FAULTS_MINOR = 0
USAGE_FAULTS_MAJOR = 1
USAGE_SWITCHES_VOLUNTARY = 2
USAGE_SWITCHES_INVOLUNTARY = 3
USAGE_CPU = 4
USAGE_RUN_DELAY_NS = 5  # -1 where the kernel does not tell
USAGE_SIZE = 6

RUSAGE_SIZE = 18  # struct rusage on 64-bit Linux: 18 words (getrusage(2))
_RUSAGE_MINOR, _RUSAGE_MAJOR, _RUSAGE_VOLUNTARY, _RUSAGE_INVOLUNTARY = 8, 9, 16, 17
_RUSAGE_THREAD = 1
SCHEDSTAT_SIZE = 64
NO_SCHEDSTAT = -1
_SPACE, _ZERO = 32, 48
MINOR_FAULT_NS = (
    50_000  # what a minor fault may cost at worst (a page zeroed and mapped: 1 us; a huge one: 50 us and more)
)


def _libc_function(name: str, result: types.Type, *arguments: types.Type):
    """A libc function: resolved at link time when compiled (keeps the disk cache), through ctypes when not."""
    if not numba.config.DISABLE_JIT:
        return types.ExternalFunction(name, result(*arguments))
    sizes = {types.int32: ctypes.c_int32, types.int64: ctypes.c_int64, types.uintp: ctypes.c_size_t}
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    function.restype = sizes[result]
    function.argtypes = [sizes[argument] for argument in arguments]
    return function


_getrusage = _libc_function("getrusage", types.int32, types.int32, types.uintp)
_sched_getcpu = _libc_function("sched_getcpu", types.int32)
_pread = _libc_function("pread", types.int64, types.int32, types.uintp, types.uintp, types.int64)


def open_schedstat() -> int:
    """Descriptor of the calling thread's scheduler statistics for `read_usage`; NO_SCHEDSTAT where there are none.

    Open it on the thread that runs the loop: the file means the thread that opened it.
    """
    try:
        return os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return NO_SCHEDSTAT


def make_usage_scratch() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Arrays for the loop: rusage int64[18], schedstat text uint8[64], usage before and after, int64[USAGE_SIZE] each."""
    return (
        np.zeros(RUSAGE_SIZE, np.int64),
        np.zeros(SCHEDSTAT_SIZE, np.uint8),
        np.zeros(USAGE_SIZE, np.int64),
        np.zeros(USAGE_SIZE, np.int64),
    )


@hot
def _run_delay_ns(schedstat_fd, text):
    """Second number of an open schedstat file, or -1."""
    length = _pread(np.int32(schedstat_fd), text.ctypes.data, text.size, 0)
    if length <= 0:
        return np.int64(-1)
    value = np.int64(0)
    field = 0
    for place in range(length):
        if text[place] == _SPACE:
            field += 1
        elif field == 1:
            value = value * 10 + (np.int64(text[place]) - _ZERO)
        elif field > 1:
            break
    return value


@hot
def read_usage(schedstat_fd, rusage, text, usage):
    """Read the thread's counters into `usage`.

    Args:
        schedstat_fd: from `open_schedstat`, or NO_SCHEDSTAT to leave the run-queue delay out (saves 1.3 us).
        rusage: int64[RUSAGE_SIZE], scratch. text: uint8[SCHEDSTAT_SIZE], scratch.
        usage: int64[USAGE_SIZE], written.
    """
    if _getrusage(np.int32(_RUSAGE_THREAD), rusage.ctypes.data) == 0:
        usage[USAGE_FAULTS_MINOR] = rusage[_RUSAGE_MINOR]
        usage[USAGE_FAULTS_MAJOR] = rusage[_RUSAGE_MAJOR]
        usage[USAGE_SWITCHES_VOLUNTARY] = rusage[_RUSAGE_VOLUNTARY]
        usage[USAGE_SWITCHES_INVOLUNTARY] = rusage[_RUSAGE_INVOLUNTARY]
    usage[USAGE_CPU] = _sched_getcpu()
    usage[USAGE_RUN_DELAY_NS] = -1
    if schedstat_fd >= 0:
        usage[USAGE_RUN_DELAY_NS] = _run_delay_ns(schedstat_fd, text)


@hot
def longest_part(wake_lateness_ns, phase_ns):
    """What took the longest: PHASE_WAKE (the wake-up itself) or a PHASE_*; phase_ns is int64[PHASE_COUNT]."""
    longest = np.int64(PHASE_WAKE)
    longest_ns = np.int64(wake_lateness_ns)
    for phase in range(PHASE_COUNT):
        if phase_ns[phase] > longest_ns:
            longest = np.int64(phase)
            longest_ns = np.int64(phase_ns[phase])
    return longest, longest_ns


@hot
def _faults_explain(before, after, longest_ns):
    """Whether page faults between two readings can make half of `longest_ns`.

    A major one can. So can a minor one that made the thread sleep: every call of the loop but the sleep before the tick is
    non-blocking, so a second voluntary switch is a fault that waited (memory reclaim, another task's fault on the page).
    """
    minor = after[USAGE_FAULTS_MINOR] - before[USAGE_FAULTS_MINOR]
    waited = minor > 0 and after[USAGE_SWITCHES_VOLUNTARY] - before[USAGE_SWITCHES_VOLUNTARY] > 1
    major = after[USAGE_FAULTS_MAJOR] - before[USAGE_FAULTS_MAJOR]
    return major > 0 or waited or 2 * minor * MINOR_FAULT_NS >= longest_ns


@hot
def suspect_cause(
    wake_lateness_ns, carried_ns, phase_ns, before, after, frame_count, burst_frame_count, late, record_dropped
):
    """The longest part of a late tick and the cause that explains it best; strongest evidence first.

    A suspicion, not a proof: 0. most of the lateness was there when the tick before ended. 1. the thread waited in the run queue, or was switched out, for at least half of the
    longest part: another task. 2. page faults within the work (asleep, a thread has none) that can
    make half of it: memory. 3. more frames than a
    tick may bring: a burst. 4. another core. 5. whatever the longest part is by itself. A tick that was on time but whose
    records found the ring full names the recorder.

    Args:
        wake_lateness_ns: wake-up against deadline. carried_ns: how much of it the tick before had left over.
        phase_ns: int64[PHASE_COUNT], durations.
        before, after: int64[USAGE_SIZE], `read_usage` at the end of the tick before and of this one.
        frame_count: frames this tick took from the socket. burst_frame_count: from how many on it is a burst.
        late: the tick missed its deadline. record_dropped: the ring was full.
    Returns:
        (PHASE_* or PHASE_WAKE, CAUSE_*), both int64.
    """
    longest, longest_ns = longest_part(wake_lateness_ns - carried_ns, phase_ns)
    if record_dropped and not late:
        return np.int64(PHASE_RECORD), np.int64(CAUSE_RECORDER)
    if carried_ns > longest_ns:
        return np.int64(PHASE_WAKE), np.int64(CAUSE_CARRIED_OVER)
    involuntary = after[USAGE_SWITCHES_INVOLUNTARY] - before[USAGE_SWITCHES_INVOLUNTARY]
    if before[USAGE_RUN_DELAY_NS] >= 0 and after[USAGE_RUN_DELAY_NS] >= 0:
        waited_ns = after[USAGE_RUN_DELAY_NS] - before[USAGE_RUN_DELAY_NS]
        preempted = 2 * waited_ns >= longest_ns
    else:
        preempted = involuntary > 0
    cause = np.int64(CAUSE_UNKNOWN)
    if preempted:
        cause = np.int64(CAUSE_PREEMPTED)
    elif longest != PHASE_WAKE and _faults_explain(before, after, longest_ns):
        cause = np.int64(CAUSE_PAGE_FAULT)
    elif frame_count >= burst_frame_count and longest != PHASE_WAKE and longest != PHASE_STEP:
        cause = np.int64(CAUSE_FRAME_BURST)
    elif after[USAGE_CPU] != before[USAGE_CPU]:
        cause = np.int64(CAUSE_MIGRATED)
    elif longest == PHASE_WAKE:
        cause = np.int64(CAUSE_LATE_WAKE)
    elif longest == PHASE_STEP:
        cause = np.int64(CAUSE_STEP)
    elif longest == PHASE_ENCODE:
        cause = np.int64(CAUSE_SEND)
    elif record_dropped and longest == PHASE_RECORD:
        cause = np.int64(CAUSE_RECORDER)
    elif involuntary > 0:
        cause = np.int64(CAUSE_PREEMPTED)
    return longest, cause
