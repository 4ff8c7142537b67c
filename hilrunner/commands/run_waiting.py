"""What a running bench waits for, and what arrives that nobody mapped: read from the loop's own arrays while it runs."""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.records import CAN_FRAME_SENT
from hilrunner.base.units import NS_PER_S
from hilrunner.realtime.decode import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, NEVER

_ID_MASK = 0x1FFFFFFF
_TOLD_AFTER_S = 1.0  # a rate needs some frames
_MOST_IDS = 32
_SOURCE_MASK = 0x00FFFF00  # of a J1939 identifier: its parameter group, without priority and source address


@dataclass
class _Seen:
    """Frames of one identifier."""

    count: int
    first_ns: int
    last_ns: int

    @property
    def rate_hz(self) -> float:
        """Frames a second, over the time they came."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0


class UnknownIds:
    """Identifiers that arrive and are mapped to nothing; `update` now and then, at least every few seconds.

    Args:
        bench: the armed bench; frames are seen where they are recorded. database: of the profile, for the names of its messages.
    """

    def __init__(self, bench, database) -> None:
        self._bench = bench
        self._names = {
            one.frame_id | (CAN_EFF_FLAG if one.is_extended_frame else 0): one.name for one in database.messages
        }
        self._next = 0
        self._seen: dict[int, _Seen] = {}
        self._told: set[int] = set()

    def update(self) -> None:
        """Count what came since the last call; what the ring has overwritten meanwhile is not counted."""
        box = self._bench.ring
        capacity = len(box.can)
        written = ring_layout.word(box, ring_layout.WORD_CAN_WRITTEN)
        first = max(self._next, written - capacity // 2)
        self._next = written
        if written <= first:
            return
        rows = box.can[np.arange(first, written) & (capacity - 1)]
        rows = rows[(rows["status"] == status.FRAME_UNKNOWN_ID) & (rows["flags"] & CAN_FRAME_SENT == 0)]
        for identifier in np.unique(rows["can_id"]).tolist():
            if identifier & (CAN_ERR_FLAG | CAN_RTR_FLAG):
                continue
            stamps = rows["mono_ns"][rows["can_id"] == identifier]
            if identifier not in self._seen and len(self._seen) >= _MOST_IDS:
                continue
            seen = self._seen.setdefault(identifier, _Seen(0, int(stamps[0]), 0))
            seen.count += len(stamps)
            seen.last_ns = int(stamps[-1])

    def news(self) -> list[str]:
        """One sentence for each identifier that has come for a second and was not told yet."""
        found = []
        for identifier, seen in self._seen.items():
            if identifier not in self._told and seen.last_ns - seen.first_ns >= _TOLD_AFTER_S * NS_PER_S:
                self._told.add(identifier)
                found.append(self._sentence(identifier, seen))
        return found

    def summary(self) -> list[dict]:
        """Every identifier that came, for the end of the run; most frames first."""
        order = sorted(self._seen.items(), key=lambda one: -one[1].count)
        return [
            {
                "id": _text(identifier),
                "count": seen.count,
                "rate_hz": round(seen.rate_hz, 1),
                "hint": self._hint(identifier),
            }
            for identifier, seen in order
        ]

    def _sentence(self, identifier: int, seen: _Seen) -> str:
        hint = self._hint(identifier)
        rate = f"{seen.rate_hz:.0f} Hz" if seen.rate_hz >= 1 else f"{seen.rate_hz:.2g} Hz"
        return f"{_text(identifier)} arrives at {rate} and is mapped to nothing{': ' + hint if hint else ''}"

    def _hint(self, identifier: int) -> str:
        """What the user may have meant."""
        if identifier in self._names:
            return f"the database calls it {self._names[identifier]}, which the profile does not map"
        mapped = [int(one) for one in self._bench.command_table.can_id]
        for other in mapped:
            if other & _ID_MASK == identifier & _ID_MASK:
                kind = "11" if other & CAN_EFF_FLAG else "29"
                return f"did you mean {_text(other)}? It has the same number, but came with {kind} bits"
        for other in mapped:
            if identifier & other & CAN_EFF_FLAG and not (identifier ^ other) & _SOURCE_MASK:
                return f"did you mean {_text(other)}? It is the same parameter group with another priority or source address"
        near = [other for other in mapped if abs((other & _ID_MASK) - (identifier & _ID_MASK)) <= 2]
        return f"did you mean {_text(near[0])}?" if near else ""


def _text(identifier: int) -> str:
    return f"0x{identifier & _ID_MASK:0{8 if identifier & CAN_EFF_FLAG else 3}X}"


def waits_for(bench, names: list[str], axis: int = 0) -> str:
    """What an axis waits for, in words; empty when it waits for nothing.

    Args:
        names: of the messages of the command table.
    """
    mode = int(bench.commands[axis]["mode"])
    if mode == status.MODE_FAIL_SAFE:
        return "waits for Reset"
    table = bench.command_table
    lacking = []
    for message, row in enumerate(table.frames):
        for group in range(int(row["group_first"]), int(row["group_first"]) + int(row["group_count"])):
            if int(table.groups[group]["axis"]) == axis and int(bench.group_tick[group]) == NEVER:
                lacking.append(f"{names[message]} {_text(int(row['can_id']))}")
    if mode != status.MODE_WAITING or not lacking:
        return "waits for a newer command" if mode in (status.MODE_STALE_HOLD, status.MODE_STALE_RAMP) else ""
    return "waits for " + ", ".join(dict.fromkeys(lacking))
