"""`cyclictest` (Debian package rt-tests) as the yardstick: what this kernel and core give a thread that only sleeps.

Same clock, priority, period and core as our loop; every wake-up in nanoseconds (`-N -v`). It leaves out the periods it
skipped after a stall; `corrected` adds them by the rule our loop uses, so that both tell of a stall alike.
"""

import shutil
import subprocess

import numpy as np

from hilrunner.base import histogram_scale
from hilrunner.base.units import NS_PER_S, NS_PER_US


def program() -> str | None:
    """Path of cyclictest, or None."""
    return shutil.which("cyclictest") or shutil.which("cyclictest", path="/usr/sbin:/usr/bin:/usr/local/bin")


def command(cpu: int, other_cpu: int, priority: int, period_ns: int, count: int) -> list[str]:
    """The command line of one slice; its printing thread stays off the measured core."""
    words = [program() or "cyclictest", "-N", "-v", "-m", "-t1", f"-a{cpu}", f"--mainaffinity={other_cpu}"]
    return [*words, f"-p{priority}", f"-i{period_ns // NS_PER_US}", f"-l{count}"]


def parse(text: str) -> np.ndarray:
    """Wake-up lateness of every cycle, int64 ns, from the `task: cycle: value` lines of -v."""
    values = []
    for line in text.splitlines():
        words = line.split(":")
        if len(words) == 3 and words[0].strip().isdigit() and words[2].strip().lstrip("-").isdigit():
            values.append(int(words[2]))
    return np.array(values, np.int64)


def corrected(lateness_ns: np.ndarray, period_ns: int) -> np.ndarray:
    """The same with the wake-ups that a stall swallowed: lateness - k period for every whole period of it."""
    extra = [lateness_ns]
    remaining = lateness_ns - period_ns
    while np.any(remaining >= 0):
        remaining = remaining[remaining >= 0]
        extra.append(remaining)
        remaining = remaining - period_ns
    return np.concatenate(extra)


def run_slice(cpu: int, other_cpu: int, priority: int, period_ns: int, slice_s: float) -> tuple[np.ndarray, np.ndarray]:
    """One slice as histogram row and extreme row (base.histogram_scale).

    Raises:
        OSError, subprocess.SubprocessError: it is missing, was refused its priority, or hangs.
    """
    count = max(1, int(slice_s * NS_PER_S / period_ns))
    words = command(cpu, other_cpu, priority, period_ns, count)
    done = subprocess.run(words, capture_output=True, text=True, timeout=20 * slice_s + 10, check=True)
    return histogram_scale.from_values(corrected(parse(done.stdout), period_ns))
