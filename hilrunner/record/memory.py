"""How much memory this process has used at most."""

import resource
from pathlib import Path

_STATUS = Path("/proc/self/status")


def memory_bytes_max() -> int:
    """Largest resident memory of this process since its program began; bytes.

    By VmHWM of /proc/self/status (proc(5)). `ru_maxrss` of getrusage is no measure of a child: exec does not set it back, so a child starts
    with the largest value of its parent (445 MB stood beside 180 MB of a recorder).
    """
    try:
        rows = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines() if ":" in line)
        return int(rows["VmHWM"].split()[0]) * 1024
    except (OSError, KeyError, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
