"""What a period leaves in the ring: its frames, its tick with the commands and states of all axes. A full ring drops whole ticks.

The frames of a tick are published before the tick itself, so that a reader who sees a tick has its frames.
"""

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.compiled import hot
from hilrunner.base.records import (
    CAN_FRAME_SENT,
    TICK_FLAG_FORCED_FAIL_SAFE,
    TICK_FLAG_MISS,
    TICK_FLAG_NEAR_MISS,
    TICK_FLAG_SKIPPED,
)
from hilrunner.realtime import ring
from hilrunner.realtime.clock import now_mono_ns
from hilrunner.realtime.cycle import fill_command_record, fill_state_record

_STRIDE = ring_layout.HEADER_STRIDE
_NO_SLOT = -1
_DURATION_NS_MAX = 0xFFFFFFFF


@hot
def record_received(bench, tick, first, end, wake_ns):
    """Frames `first` to `end` - 1 of the inbox, received by this tick."""
    if bench.config[0]["record"] == 0:
        return
    for k in range(first, end):
        frame = bench.inbox.frame[k]
        length = min(np.int64(frame[4]), np.int64(64))
        fd = np.int64(1 if bench.inbox.size_bytes[k] > 16 else 0)
        ring.push_can(
            bench.ring, tick, _frame_id(frame), fd, length, bench.frame_status[k], bench.frame_axis[k],
            bench.inbox.kernel_real_ns[k], wake_ns, frame, 8,
        )  # fmt: skip


@hot
def record_sent(bench, tick, sent, sent_ns):
    """The first `sent` frames of the outbox."""
    if bench.config[0]["record"] == 0:
        return
    for k in range(sent):
        frame = bench.outbox.frame[k]
        fd = np.int64(1 if bench.outbox.size_bytes[k] > 16 else 0)
        ring.push_can(
            bench.ring, tick, _frame_id(frame), fd | CAN_FRAME_SENT, np.int64(frame[4]), np.int64(0), np.int64(255),
            np.int64(0), sent_ns, frame, 8,
        )  # fmt: skip


@hot
def _frame_id(frame):
    return np.int64(frame[0]) | np.int64(frame[1]) << 8 | np.int64(frame[2]) << 16 | np.int64(frame[3]) << 24


@hot
def record_tick(bench, tick, skipped, deadline_mono_ns, wake_ns, received, due_mono_ns):
    """Fill TICK, COMMAND and STATE of this tick and publish them together; True when the ring was full.

    Args:
        skipped: periods before this tick that have no row. due_mono_ns: when it had to be over; later it is a miss.
    """
    slot = _fill(bench, tick, deadline_mono_ns, wake_ns, received)
    if slot == _NO_SLOT:
        return bench.config[0]["record"] != 0
    row = bench.ring.tick[slot]
    row["receive_ns"] = _duration(bench.phase_ns[status.PHASE_RECEIVE])
    row["decode_ns"] = _duration(bench.phase_ns[status.PHASE_DECODE])
    row["step_ns"] = _duration(bench.phase_ns[status.PHASE_STEP])
    row["encode_ns"] = _duration(bench.phase_ns[status.PHASE_ENCODE])
    row["record_ns"] = _duration(bench.progress[0]["record_ns_before"])
    row["skipped_count"] = skipped
    end_ns = now_mono_ns(bench.clock)
    row["end_mono_ns"] = end_ns
    row["flags"] = _tick_flags(bench, end_ns - due_mono_ns)
    ring.publish(bench.ring.header, ring_layout.WORD_TICK_WRITTEN)
    return False


@hot
def record_skipped(bench, tick, deadline_mono_ns, wake_ns, received):
    """The same for a skipped period, computed after its time: no durations, and no miss of its own."""
    slot = _fill(bench, tick, deadline_mono_ns, wake_ns, received)
    if slot == _NO_SLOT:
        return
    row = bench.ring.tick[slot]
    row["receive_ns"] = 0
    row["decode_ns"] = 0
    row["step_ns"] = 0
    row["encode_ns"] = 0
    row["record_ns"] = 0
    row["skipped_count"] = 0
    row["end_mono_ns"] = now_mono_ns(bench.clock)
    row["flags"] = TICK_FLAG_SKIPPED | _forced_flag(bench.progress[0])
    ring.publish(bench.ring.header, ring_layout.WORD_TICK_WRITTEN)


@hot
def _duration(value_ns):
    """As a row holds it: 32 bits, a stall of 4.3 s and more within one phase stays at the most of them."""
    return min(max(value_ns, 0), _DURATION_NS_MAX)


@hot
def _fill(bench, tick, deadline_mono_ns, wake_ns, received):
    """Commands, states and what every TICK row holds, in the next free slot; _NO_SLOT when there is none (counted) or no log."""
    if bench.config[0]["record"] == 0:
        return np.int64(_NO_SLOT)
    box = bench.ring
    header = box.header
    capacity = box.tick.shape[0]
    if not ring.has_room(header, ring_layout.WORD_TICK_WRITTEN, ring_layout.WORD_TICK_READ, capacity):
        ring.count_drop(header, ring_layout.WORD_TICK_DROPPED)
        return np.int64(_NO_SLOT)
    slot = header[ring_layout.WORD_TICK_WRITTEN * _STRIDE] & (capacity - 1)
    axis_count = bench.state.shape[0]
    for axis in range(axis_count):
        fill_command_record(bench, axis, tick, box.command[slot * axis_count + axis])
        fill_state_record(bench, axis, tick, box.state[slot * axis_count + axis])
    row = box.tick[slot]
    row["tick"] = tick
    row["deadline_mono_ns"] = deadline_mono_ns
    row["wake_mono_ns"] = wake_ns
    row["frames_received"] = received
    return np.int64(slot)


@hot
def _tick_flags(bench, late_ns):
    progress = bench.progress[0]
    flags = TICK_FLAG_NEAR_MISS if late_ns > 0 or progress["near_miss_left"] > 0 else 0
    if late_ns > 0:
        flags |= TICK_FLAG_MISS
    return flags | _forced_flag(progress)


@hot
def _forced_flag(progress):
    """The fail-safe forced by a limit after the tick before: the one input a replay cannot derive; told once."""
    if progress["forced_fail_safe"] == 0:
        return 0
    progress["forced_fail_safe"] = 0
    return TICK_FLAG_FORCED_FAIL_SAFE
