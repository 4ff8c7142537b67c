"""The memory of a process is its own, not the one of the process that started it."""

import subprocess
import sys

import numpy as np

from hilrunner.record.memory import memory_bytes_max

LARGE_BYTES = 300_000_000


def test_a_child_does_not_inherit_the_largest_memory_of_its_parent():
    block = np.ones(LARGE_BYTES, np.uint8)
    assert memory_bytes_max() >= LARGE_BYTES and block.all()
    words = [sys.executable, "-c", "from hilrunner.record.memory import memory_bytes_max; print(memory_bytes_max())"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert int(done.stdout) < LARGE_BYTES // 2
