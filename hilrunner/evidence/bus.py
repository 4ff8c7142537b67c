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
_SECONDS_MAX = 1 << 20  # twelve days: a stamp later than that is damage, not data
_IDS_MAX = 4096  # identifiers told one by one; a babbling node can send all 2**29
_LENGTHS = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.uint8)  # ISO 11898-1
OTHER_IDS = "others"


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
        self._others = {"received": 0, "sent": 0}
        self._stamps: dict[str, list[np.ndarray]] = {"received": [], "sent": []}  # int64[n, 2]: tick, stamp
        self._answers = False  # frames that were sent carry stamps; those of SocketCAN do not

    def __call__(self, topic: str, rows: np.ndarray) -> None:
        """Count one batch."""
        if not len(rows):
            return
        direction = "sent" if topic.endswith("tx") else "received"
        self._counts[direction] += len(rows)
        ids, counts = np.unique(rows["can_id"], return_counts=True)
        for can_id, count in zip((ids & _ID_MASK).tolist(), counts.tolist(), strict=True):
            known = can_id in self._by_id or len(self._by_id) < _IDS_MAX
            of_id = self._by_id.setdefault(can_id, {"received": 0, "sent": 0}) if known else self._others
            of_id[direction] += count
        self._count_seconds(rows)
        answered = rows["kernel_real_ns"] > 0
        if direction == "received":
            self._outcomes += np.bincount(rows["status"], minlength=256)
            answered &= rows["status"] == status.FRAME_VALID
        self._answers |= direction == "sent" and bool(answered.any())
        self._keep_stamps(direction, rows["tick"][answered], rows["kernel_real_ns"][answered])

    def result(self, bitrate: int) -> BusUse:
        """Everything counted; `bitrate` in bit/s, 0: not known."""
        rejected = {
            name: int(self._outcomes[code])
            for code, name in enumerate(status.FRAME_STATUS_NAMES)
            if code != status.FRAME_VALID and self._outcomes[code]
        }
        load = self._load(bitrate)
        by_id = {f"{can_id:#05x}": self._by_id[can_id] for can_id in sorted(self._by_id)}
        if any(self._others.values()):
            by_id[OTHER_IDS] = self._others
        return BusUse(
            received_count=self._counts["received"],
            sent_count=self._counts["sent"],
            rejected=rejected,
            by_id=by_id,
            bitrate=bitrate,
            load_ratio_mean=float(load.mean()) if len(load) else 0.0,
            load_ratio_max=float(load.max()) if len(load) else 0.0,
            load_per_s=load,
        )

    def responses_ns(self, first_tick: int) -> np.ndarray:
        """From the stamp of the newest valid command of a tick to the last answer sent in it, int64; both must carry one."""
        if not self._stamps["received"] or not self._stamps["sent"]:
            return np.zeros(0, np.int64)
        received, sent = (_newest(np.concatenate(self._stamps[name])) for name in ("received", "sent"))
        _, at_received, at_sent = np.intersect1d(received[:, 0], sent[:, 0], assume_unique=True, return_indices=True)
        values = (sent[at_sent, 1] - received[at_received, 1])[received[at_received, 0] >= first_tick]
        return values[values >= 0]

    def _count_seconds(self, rows: np.ndarray) -> None:
        times = rows["mono_ns"]
        if self._start_ns is None:
            self._start_ns = int(times.min())
        self._end_ns = max(self._end_ns, int(times.max()))
        second = np.maximum(times - self._start_ns, 0) // NS_PER_S
        kinds = _LENGTHS[np.minimum(np.searchsorted(_LENGTHS, rows["length"]), len(_LENGTHS) - 1)].astype(np.int32)
        kinds |= (rows["can_id"] >= _EXTENDED).astype(np.int32) << 8
        kinds |= (rows["flags"] & _FD).astype(np.int32) << 9
        for kind in np.unique(kinds).tolist():
            at = second[kinds == kind]
            counts = np.bincount(at[at < _SECONDS_MAX]).astype(np.uint32)
            before = self._kinds.get(kind, np.zeros(0, np.uint32))
            short, long = sorted((counts, before), key=len)
            long[: len(short)] += short
            self._kinds[kind] = long

    def _keep_stamps(self, direction: str, tick: np.ndarray, stamp: np.ndarray) -> None:
        if self._counts["sent"] and not self._answers:
            self._stamps["received"].clear()  # nothing will answer them: a run of days needs no room for them
        elif len(tick):
            self._stamps[direction].append(_newest(np.column_stack((tick.astype(np.int64), stamp))))

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


def _newest(pairs: np.ndarray) -> np.ndarray:
    """Rows (tick, stamp) in order of tick, of each tick the last that came."""
    if np.any(pairs[1:, 0] < pairs[:-1, 0]):
        pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return pairs[np.append(pairs[1:, 0] != pairs[:-1, 0], True)]
