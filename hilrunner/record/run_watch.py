"""What befalls a run beside its records, put into words as soon as it is seen: stalls, drops, another bench, a wall clock that is set.

The loop only counts; whoever watches reads its counts now and then and tells what is new.
"""

import time

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.units import NS_PER_MS, NS_PER_S
from hilrunner.record.drain import Drain
from hilrunner.record.levels import LOG_LEVEL_ERROR, LOG_LEVEL_WARNING

CLOCK_SET_NS = 10_000_000  # a wall clock that moved by more between two looks was set, not disciplined


class RunWatch:
    """Remembers what has been told."""

    def __init__(self, drain: Drain, period_ns: int) -> None:
        self._drain = drain
        self._period_ns = period_ns
        self._seen: dict[str, int] = {}
        self._offset_ns = _clock_offset_ns()
        self.clock_sets = 0

    def news(self, tick: int) -> list[tuple[int, str]]:
        """(level, sentence) of everything new since the last call; `tick` is the newest one recorded."""
        told = []
        dropped = self._drain.dropped()
        full = [self._more(kind, count, kind, tick) for kind, count in zip(dropped._fields, dropped, strict=True)]
        if any(full):
            told.append((LOG_LEVEL_ERROR, f"ring full: {'; '.join(text for text in full if text)}"))
        lost = self._drain.word(ring_layout.WORD_KERNEL_DROPPED)
        if text := self._more("kernel", lost, "frames", tick):
            told.append((LOG_LEVEL_ERROR, f"the receive buffer of the socket was full: {text}"))
        foreign = int(self._drain.ring.frame_count[:, status.FRAME_OWN_ID].sum())
        new = foreign - self._seen.get("foreign", 0)
        self._seen["foreign"] = foreign
        if new > 0:
            text = f"another bench is on this bus: {new} frames near tick {tick} carry identifiers that this bench sends, {foreign} in all"
            told.append((LOG_LEVEL_ERROR, text))
        return [*told, *self._stalls(), *self._clock(tick)]

    def _more(self, key: str, count: int, kind: str, tick: int) -> str:
        """`3 frames dropped near tick 80, 5 in all`, or nothing."""
        new = count - self._seen.get(key, 0)
        self._seen[key] = count
        return f"{new} {kind} dropped near tick {tick}, {count} in all" if new > 0 else ""

    def _stalls(self) -> list[tuple[int, str]]:
        count = self._drain.word(ring_layout.WORD_STALL_COUNT)
        new = count - self._seen.get("stalls", 0)
        self._seen["stalls"] = count
        if new <= 0:
            return []
        last_ms = self._drain.word(ring_layout.WORD_STALL_NS_LAST) / NS_PER_MS
        tick = self._drain.word(ring_layout.WORD_STALL_TICK_LAST)
        more = f"; {new} stalls since the last message" if new > 1 else ""
        text = f"the bench stalled: its host let it serve no period for {last_ms:.1f} ms before tick {tick}{more}"
        return [(LOG_LEVEL_ERROR, text)]

    def _clock(self, tick: int) -> list[tuple[int, str]]:
        offset_ns = _clock_offset_ns()
        moved_ns = offset_ns - self._offset_ns
        self._offset_ns = offset_ns
        if abs(moved_ns) <= CLOCK_SET_NS:
            return []
        self.clock_sets += 1
        text = f"the wall clock was set by {moved_ns / NS_PER_S:+.3f} s near tick {tick}; the times of this log go on by the old one"
        return [(LOG_LEVEL_WARNING, text)]


def _clock_offset_ns() -> int:
    """CLOCK_REALTIME - CLOCK_MONOTONIC: of three readings the one with the least time around it."""
    readings = []
    for _ in range(3):
        before_ns = time.monotonic_ns()
        real_ns = time.time_ns()
        around_ns = time.monotonic_ns() - before_ns
        readings.append((around_ns, real_ns - before_ns - around_ns // 2))
    return min(readings)[1]
