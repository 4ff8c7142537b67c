"""Is it true? A short run of absolute sleeps, as the loop makes them: how late does this thread wake, alone and disturbed?

The same calls, clock and thread as the loop's: what a kernel says of its preemption is read in `host_kernel`, here it is tried.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilrunner.base.compiled import entry
from hilrunner.base.units import NS_PER_S, NS_PER_US
from hilrunner.realtime.clock import make_clock, now_mono_ns, wait_until
from hilrunner.setup.host_words import FAIL, OK, WARN, Finding

WARN_PERIOD_RATIO = 0.1  # of a period; 100 us at 1 kHz
FAIL_PERIOD_RATIO = 0.5  # no time is left for the tick itself
_READS = 1000

# Large page-faulting allocations and long reads: work inside the kernel that only a preemptible kernel interrupts.
_DISTURBER = """
import os
zero = os.open("/dev/zero", os.O_RDONLY)
while True:
    os.readv(zero, [bytearray(32 << 20)])
"""


@dataclass(frozen=True)
class WakeProbe:
    """Wake-up lateness of a probe, sorted, ns, with the scheduling it ran under."""

    lateness_ns: np.ndarray
    scheduling: str
    cpu: int
    clock_read_ns: float

    def quantile_us(self, ratio: float) -> float:
        """Lateness that `ratio` of the wake-ups did not exceed, us."""
        place = min(self.lateness_ns.size - 1, int(np.ceil(ratio * self.lateness_ns.size)) - 1)
        return float(self.lateness_ns[max(place, 0)]) / NS_PER_US


@entry
def _wake_many(clock, period_ns, lateness_ns):
    """Sleep to points of a grid and keep how late each wake-up was; points already past are skipped."""
    deadline = now_mono_ns(clock) + period_ns
    for k in range(lateness_ns.size):
        wait_until(clock, deadline)
        late = now_mono_ns(clock) - deadline
        lateness_ns[k] = late
        deadline += period_ns * (1 + late // period_ns)


@entry
def _read_many(clock, count):
    """Time that `count` readings of the clock take, ns."""
    start = now_mono_ns(clock)
    for _ in range(count):
        now_mono_ns(clock)
    return now_mono_ns(clock) - start


def _scheduling() -> str:
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy == os.SCHED_FIFO:
        return f"SCHED_FIFO {os.sched_getparam(0).sched_priority}"
    return "SCHED_RR" if policy == os.SCHED_RR else "no real-time priority"


def probe_wake_up(period_ns: int, duration_s: float) -> WakeProbe:
    """Measure the calling thread's wake-ups on a grid of `period_ns` for about `duration_s`; the first tenth is warm-up."""
    clock = make_clock(0)
    count = max(10, int(duration_s * NS_PER_S / period_ns))
    lateness_ns = np.zeros(count, np.int64)
    _wake_many(clock, period_ns, lateness_ns[: max(1, count // 10)])
    _wake_many(clock, period_ns, lateness_ns)
    _read_many(clock, 10)
    read_ns = _read_many(clock, _READS) / _READS
    cpu = next(iter(os.sched_getaffinity(0))) if len(os.sched_getaffinity(0)) == 1 else -1
    return WakeProbe(np.sort(lateness_ns), _scheduling(), cpu, read_ns)


@contextlib.contextmanager
def disturbed(cpu: int) -> Iterator[None]:
    """An ordinary task that keeps the kernel busy on the same core while the block runs."""
    process = subprocess.Popen([sys.executable, "-I", "-S", "-c", _DISTURBER], stdin=subprocess.DEVNULL)
    try:
        if cpu >= 0:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(process.pid, {cpu})
        yield
    finally:
        process.kill()
        process.wait()


def wake_finding(name: str, probe: WakeProbe, period_ns: int) -> Finding:
    """Judge a probe: its worst wake-up against the period."""
    worst_us = probe.quantile_us(1.0)
    where = f" on core {probe.cpu}" if probe.cpu >= 0 else ""
    value = (
        f"late by p50 {probe.quantile_us(0.5):.1f}, p99 {probe.quantile_us(0.99):.1f}, max {worst_us:.1f} us"
        f" in {probe.lateness_ns.size} wake-ups, {probe.scheduling}{where}"
    )
    ratio = worst_us * NS_PER_US / period_ns
    if ratio <= WARN_PERIOD_RATIO:
        return Finding(name, value, OK)
    remedy = "mend the findings above, first those that fail; then look with: cyclictest -m -p 80 -i 1000 -q -D 60"
    return Finding(name, value, FAIL if ratio >= FAIL_PERIOD_RATIO else WARN, remedy)


def clock_finding(probe: WakeProbe) -> Finding:
    """Judge what one reading of the clock costs: a slow clock source shows here."""
    value = f"{probe.clock_read_ns:.0f} ns a read"
    if probe.clock_read_ns <= 200:
        return Finding("clock reading", value, OK)
    return Finding(
        "clock reading", value, WARN, "the clock is read by a system call: use a clocksource with a vDSO (tsc)"
    )
