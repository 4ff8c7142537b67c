"""What the bus carried: frames by id, what became of the received ones, the load as if at the profile's bit rate, responses.

Counted batch by batch while the log is read, so that an hour of frames is never in memory at once.
"""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import status
from hilrunner.base.units import NS_PER_S
from hilrunner.setup.host_can import FrameTraffic, bus_load_ratio

_EXTENDED = 1 << 31
_ID_MASK = (1 << 29) - 1
_FD = 1
_GROWTH_MAX = 1 << 22  # a count or stamp further than this beyond all before it is damage, not data


@dataclass(frozen=True)
class BusUse:
    """Load ratios count worst-case bit stuffing; 0 where no bit rate is known."""

    received_count: int
    sent_count: int
    rejected: dict[str, int]  # by what became of the frame
    by_id: dict[str, dict[str, int]]  # hexadecimal id -> received, sent
    bitrate: int
    load_ratio_mean: float
    load_ratio_max: float  # worst whole second
    load_per_s: np.ndarray  # float64[seconds]


class BusTally:
    """Consumer of /can/rx and /can/tx (evidence.reader)."""

    COLUMNS = ("tick", "kernel_real_ns", "mono_ns", "can_id", "length", "flags", "status")

    def __init__(self) -> None:
        self._counts = {"received": 0, "sent": 0}
        self._outcomes = np.zeros(256, np.int64)
        self._by_id: dict[int, dict[str, int]] = {}
        self._start_ns: int | None = None
        self._end_ns = 0
        self._kinds: dict[int, np.ndarray] = {}  # kind of frame -> frames in each second
        self._stamps = {"received": np.zeros(0, np.int64), "sent": np.zeros(0, np.int64)}

    def __call__(self, topic: str, rows: np.ndarray) -> None:
        """Count one batch."""
        if not len(rows):
            return
        direction = "sent" if topic.endswith("tx") else "received"
        self._counts[direction] += len(rows)
        ids, counts = np.unique(rows["can_id"], return_counts=True)
        for can_id, count in zip((ids & _ID_MASK).tolist(), counts.tolist(), strict=True):
            self._by_id.setdefault(can_id, {"received": 0, "sent": 0})[direction] += count
        self._count_seconds(rows)
        answered = rows["kernel_real_ns"] > 0
        if direction == "received":
            self._outcomes += np.bincount(rows["status"], minlength=256)
            answered &= rows["status"] == status.FRAME_VALID
        self._keep_stamps(direction, rows["tick"][answered], rows["kernel_real_ns"][answered])

    def result(self, bitrate: int) -> BusUse:
        """Everything counted; `bitrate` in bit/s, 0: not known."""
        rejected = {
            name: int(self._outcomes[code])
            for code, name in enumerate(status.FRAME_STATUS_NAMES)
            if code != status.FRAME_VALID and self._outcomes[code]
        }
        load = self._load(bitrate)
        return BusUse(
            received_count=self._counts["received"],
            sent_count=self._counts["sent"],
            rejected=rejected,
            by_id={f"{can_id:#05x}": self._by_id[can_id] for can_id in sorted(self._by_id)},
            bitrate=bitrate,
            load_ratio_mean=float(load.mean()) if len(load) else 0.0,
            load_ratio_max=float(load.max()) if len(load) else 0.0,
            load_per_s=load,
        )

    def responses_ns(self, first_tick: int) -> np.ndarray:
        """From the stamp of the newest valid command of a tick to the last answer sent in it, int64; both must carry one."""
        received, sent = self._stamps["received"], self._stamps["sent"]
        count = min(len(received), len(sent))
        received, sent = received[first_tick:count], sent[first_tick:count]
        values = (sent - received)[(received > 0) & (sent > 0)]
        return values[values >= 0]

    def _count_seconds(self, rows: np.ndarray) -> None:
        times = rows["mono_ns"]
        if self._start_ns is None:
            self._start_ns = int(times.min())
        self._end_ns = max(self._end_ns, int(times.max()))
        second = np.maximum(times - self._start_ns, 0) // NS_PER_S
        kinds = rows["length"].astype(np.int32)
        kinds |= (rows["can_id"] >= _EXTENDED).astype(np.int32) << 8
        kinds |= (rows["flags"] & _FD).astype(np.int32) << 9
        for kind in np.unique(kinds).tolist():
            at = second[kinds == kind]
            before = self._kinds.get(kind, np.zeros(0, np.int64))
            at = at[at < len(before) + _GROWTH_MAX]
            counts = np.bincount(at, minlength=len(before))
            counts[: len(before)] += before
            self._kinds[kind] = counts

    def _keep_stamps(self, direction: str, tick: np.ndarray, stamp: np.ndarray) -> None:
        kept = self._stamps[direction]
        near = tick < len(kept) + _GROWTH_MAX
        tick, stamp = tick[near].astype(np.int64), stamp[near]
        if len(tick) and int(tick.max()) >= len(kept):
            grown = np.zeros(int(tick.max() * 1.5) + 1024, np.int64)
            grown[: len(kept)] = kept
            kept = self._stamps[direction] = grown
        kept[tick] = stamp  # the last of a tick stays

    def _load(self, bitrate: int) -> np.ndarray:
        if bitrate <= 0 or self._start_ns is None:
            return np.zeros(0)
        seconds = max(int((self._end_ns - self._start_ns) // NS_PER_S), 1)  # a broken last second is left out
        load = np.zeros(min(seconds, max(len(counts) for counts in self._kinds.values())))
        for kind, counts in self._kinds.items():
            frame = FrameTraffic(1.0, kind & 0xFF, bool(kind >> 8 & 1), bool(kind >> 9 & 1))
            part = counts[: len(load)] * bus_load_ratio([frame], bitrate)
            load[: len(part)] += part
        return load
