"""Long compiled work in blocks of a tenth of a second: compiled code hears no Ctrl-C, the interpreter between two blocks does."""

import time
from collections.abc import Iterator

BLOCK_S = 0.1


def blocks(count: int, most: int) -> Iterator[tuple[int, int]]:
    """(start, stop) over 0..count; a block grows up to `most` while the last one took less than half of BLOCK_S, and shrinks otherwise."""
    start, size = 0, 1
    while start < count:
        stop = min(count, start + size)
        begin_s = time.perf_counter()
        yield start, stop
        quick = time.perf_counter() - begin_s < BLOCK_S / 2
        size = min(2 * size, most) if quick else max(1, size // 2)
        start = stop
