"""`cyclictest` (Debian package rt-tests) as the yardstick: what this kernel and core give a thread that only sleeps.

Same clock, priority, period and core as our loop; every wake-up in nanoseconds (`-N -v`). It leaves out the periods it
skipped after a stall; `corrected` adds them by the rule our loop uses, so that both tell of a stall alike.
"""

import shutil
import subprocess
from functools import cache

import numpy as np

from hilrunner.base import histogram_scale
from hilrunner.base.units import NS_PER_MS, NS_PER_S, NS_PER_US

_TRIAL_LIMIT_S = 30.0


def program() -> str | None:
    """Path of cyclictest, or None."""
    return shutil.which("cyclictest") or shutil.which("cyclictest", path="/usr/sbin:/usr/bin:/usr/local/bin")


def command(cpu: int, other_cpu: int, priority: int, period_ns: int, count: int) -> list[str]:
    """The command line of one slice; its printing thread stays off the measured core."""
    words = [program() or "cyclictest", "-N", "-v", "-m", "-t1", f"-a{cpu}", f"--mainaffinity={other_cpu}"]
    return [*words, f"-p{priority}", f"-i{period_ns // NS_PER_US}", f"-l{count}"]


@cache
def left_out(cpu: int, other_cpu: int, priority: int) -> str:
    """Why no figure of cyclictest can be had here, as a note for the table; empty if it can. Tried with one wake-up.

    A machine may have it and not grant it what it asks for: a container without CAP_SYS_NICE, a control group without real time.
    """
    if program() is None:
        return "cyclictest is not installed (apt install rt-tests): no ratio"
    words = command(cpu, other_cpu, priority, NS_PER_MS, 1)
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_TRIAL_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"cyclictest cannot be run here ({error}): no ratio"
    if done.returncode == 0:
        return ""
    said = (done.stderr.strip() or done.stdout.strip() or f"it ended with {done.returncode}").splitlines()
    return f"cyclictest was refused what it needs ({said[0]}): no ratio"


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
