"""A few periods in virtual time over a bus that is three Python functions, compiled or interpreted."""

import ctypes

import numpy as np

from hilrunner.realtime import socketcan, virtual
from hilrunner.setup import arm as arming

TICKS = 4
START_MONO_NS = 1_000_000_000
_WORD = ctypes.c_int64


class _Bus:
    """Gives one frame before the second tick, takes every frame but one, and fails before the last tick."""

    def __init__(self, frame: np.ndarray) -> None:
        self.frame = frame
        self.advanced_ns: list[int] = []
        self._kept = [
            ctypes.CFUNCTYPE(_WORD, _WORD, _WORD)(self._advance),
            ctypes.CFUNCTYPE(_WORD, *[_WORD] * 5)(self._receive),
            ctypes.CFUNCTYPE(_WORD, *[_WORD] * 4)(self._send),
        ]
        self.calls = np.zeros(virtual.CALL_COUNT, np.int64)
        for place, function in zip(
            (virtual.CALL_ADVANCE, virtual.CALL_RECEIVE, virtual.CALL_SEND), self._kept, strict=True
        ):
            self.calls[place] = ctypes.cast(function, ctypes.c_void_p).value

    def _advance(self, hub, until_mono_ns):
        self.advanced_ns.append(until_mono_ns)
        return -1 if len(self.advanced_ns) == TICKS else 0

    def _receive(self, hub, frames, sizes, stamps, room):
        if len(self.advanced_ns) != 2:
            return 0
        row = (ctypes.c_uint8 * socketcan.FRAME_SIZE_FD).from_address(frames)
        row[: len(self.frame)] = self.frame.tolist()
        _WORD.from_address(sizes).value = socketcan.FRAME_SIZE_CLASSIC
        _WORD.from_address(stamps).value = START_MONO_NS
        return 1

    def _send(self, hub, frames, sizes, count):
        return count - 1 if len(self.advanced_ns) == 3 else count


def virtually(loaded, axes, frame: np.ndarray, out: dict) -> None:
    """Add what came of it to `out`."""
    shape = arming.ring_shape(loaded, seconds=0.01)._replace(tick_capacity=16, can_capacity=64, miss_capacity=16)
    armed = arming.arm(loaded, axes, arming.local_ring(shape), record=True)
    bus = _Bus(frame)
    out["virtual reason"] = np.array([virtual.run_virtual(armed.bench, bus.calls, START_MONO_NS, 0, TICKS)])
    out["virtual advanced"] = np.array(bus.advanced_ns)
    out["virtual state"] = armed.bench.state.copy()
    out["virtual frames"] = armed.bench.ring.frame_count.copy()
    out["virtual progress"] = np.array(
        [
            int(armed.bench.progress[0][name])
            for name in ("tick_count", "frames_received", "frames_sent", "frames_unsent")
        ]
    )
