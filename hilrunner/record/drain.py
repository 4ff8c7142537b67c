"""Empty the ring: hand over what is new, free it, count what the loop had to drop.

Memory order: the counts are read a cycle (tens of ms) before the records they cover, so no store of the loop can still be
on its way. Invariant: READ is stored after the records were copied by their consumers.
"""

from typing import NamedTuple, Protocol

import numpy as np

from hilrunner.base import ring as ring_layout

STRETCH_MAX = 4096  # entries handed over at once: bounds a chunk of the log after the recorder was held up


class Counts(NamedTuple):
    """Records ever published when the snapshot was taken."""

    ticks: int
    misses: int
    frames: int


class Dropped(NamedTuple):
    """Records the loop could not publish because the ring was full."""

    ticks: int
    misses: int
    frames: int


class Consumer(Protocol):
    """Who gets the records. Arrays are views into the ring: copy what is kept."""

    def take_ticks(self, tick: np.ndarray, command: np.ndarray, state: np.ndarray) -> None: ...

    def take_misses(self, miss: np.ndarray) -> None: ...

    def take_frames(self, can: np.ndarray) -> None: ...


class Drain:
    """The recorder's end of the ring."""

    def __init__(self, ring: ring_layout.Ring, shape: ring_layout.RingShape) -> None:
        self.ring = ring
        self._shape = shape
        self.fill_ratio_max = 0.0

    def word(self, index: int) -> int:
        """One header word."""
        return ring_layout.word(self.ring, index)

    def store(self, index: int, value: int) -> None:
        """Store one header word the recorder owns."""
        self.ring.header[index * ring_layout.HEADER_STRIDE] = value

    def snapshot(self) -> Counts:
        """What the loop has published so far."""
        return Counts(
            self.word(ring_layout.WORD_TICK_WRITTEN),
            self.word(ring_layout.WORD_MISS_WRITTEN),
            self.word(ring_layout.WORD_CAN_WRITTEN),
        )

    def dropped(self) -> Dropped:
        """What the loop had to drop so far."""
        return Dropped(
            self.word(ring_layout.WORD_TICK_DROPPED),
            self.word(ring_layout.WORD_MISS_DROPPED),
            self.word(ring_layout.WORD_CAN_DROPPED),
        )

    def consume(self, counts: Counts, consumer: Consumer) -> int:
        """Hand over everything up to `counts` (taken a cycle ago) and free it; returns the ticks handed over."""
        axes = self._shape.axis_count
        ring = self.ring
        read = self.word(ring_layout.WORD_TICK_READ)
        self.fill_ratio_max = max(self.fill_ratio_max, (counts.ticks - read) / self._shape.tick_capacity)
        # frames first: those of a tick are published before the tick itself
        for start, stop in _stretches(self.word(ring_layout.WORD_CAN_READ), counts.frames, self._shape.can_capacity):
            consumer.take_frames(ring.can[start:stop])
        self.store(ring_layout.WORD_CAN_READ, counts.frames)
        for start, stop in _stretches(read, counts.ticks, self._shape.tick_capacity):
            of_axes = slice(start * axes, stop * axes)
            consumer.take_ticks(ring.tick[start:stop], ring.command[of_axes], ring.state[of_axes])
        self.store(ring_layout.WORD_TICK_READ, counts.ticks)
        for start, stop in _stretches(self.word(ring_layout.WORD_MISS_READ), counts.misses, self._shape.miss_capacity):
            consumer.take_misses(ring.miss[start:stop])
        self.store(ring_layout.WORD_MISS_READ, counts.misses)
        return counts.ticks - read


def _stretches(read: int, written: int, capacity: int) -> list[tuple[int, int]]:
    """The places of entries read .. written in a ring of this capacity, as unbroken stretches of bounded length."""
    found = []
    while read < written:
        start = read % capacity
        count = min(written - read, capacity - start, STRETCH_MAX)
        found.append((start, start + count))
        read += count
    return found
