"""Layout of the shared-memory block between the loop (one producer) and the recorder (one consumer).

Design goals: the producer never waits; the consumer may die or stop at any time; a reader that starts after the
producer's death finds everything up to the last finished tick.

Invariants: `*_WRITTEN` counts records ever published and only the producer stores it, after the records (release);
`*_READ` counts records ever consumed and only the recorder stores it; written - read <= capacity, otherwise the
producer drops the whole tick (or frame, or miss) and counts it in `*_DROPPED`. TICK, COMMAND and STATE are in
lockstep: entry i of TICK belongs to entries i*axis_count .. of COMMAND and STATE.
Each header word has a cache line of its own (stride 8).
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base import records, status

MAGIC = 0x48494C52494E4732  # "HILRING2"
HEADER_STRIDE = 8

(
    WORD_MAGIC,
    WORD_AXIS_COUNT,
    WORD_TICK_CAPACITY,
    WORD_MISS_CAPACITY,
    WORD_CAN_CAPACITY,
    WORD_CAN_DATA_SIZE,
    WORD_TICK_WRITTEN,
    WORD_TICK_READ,
    WORD_TICK_DROPPED,
    WORD_MISS_WRITTEN,
    WORD_MISS_READ,
    WORD_MISS_DROPPED,
    WORD_CAN_WRITTEN,
    WORD_CAN_READ,
    WORD_CAN_DROPPED,
    WORD_START_MONO_NS,
    WORD_START_REAL_NS,  # start_mono_ns on CLOCK_REALTIME; one offset, taken once
    WORD_PERIOD_NS,
    WORD_EXIT_REASON,  # status.EXIT_*, stored by the runner when the loop has ended
    WORD_RECORDER_READY,  # 1: the log is open; 2: refused, the reason is on the recorder's stderr
    WORD_RECORDER_LOST_BYTES,  # bytes the recorder could not write (disk full)
    WORD_CHECK_FAILED_TICK,  # first tick out of tolerance + 1; 0: none
    WORD_CHECK_LAG_NS,
    WORD_STOP_REQUEST,  # 1: asked to end after the current tick (signal handler, profile action)
    WORD_SKIPPED_TOTAL,
    WORD_MISS_TOTAL,
    WORD_STALL_COUNT,  # silences of the bench longer than the profile allows
    WORD_STALL_NS_MAX,  # longest time the bench served no period, beyond the period itself
    WORD_STALL_NS_LAST,  # of the newest silence that counted
    WORD_STALL_TICK_LAST,  # the tick that ended it
    WORD_STALL_TICK_FIRST,  # the tick that ended the first one that counted, + 1; 0: none
    WORD_KERNEL_DROPPED,  # frames the kernel dropped because the receive buffer of the socket was full
    WORD_LOG_LACKS,  # LOG_LACKS_*: what the recorder found missing of the log while it writes it
    WORD_COUNT,
) = range(34)

# what a log lacks while it is written; bits of WORD_LOG_LACKS
LOG_LACKS_NAME = 1  # its file has been deleted, moved or replaced, or its disk unmounted
LOG_LACKS_DATA = 2  # the disk refused data
LOG_LACKS_TEXTS = (
    "the file of the log is gone from its place: deleted, moved, replaced, or its disk was unmounted",
    "the disk of the log refuses data",
)


class RingShape(NamedTuple):
    """Sizes that fix the block's layout."""

    axis_count: int
    tick_capacity: int  # power of two
    miss_capacity: int
    can_capacity: int
    can_data_size: int  # 8 or 64
    histogram_count: int  # len(records.HISTOGRAM_NAMES)
    bucket_count: int
    sent_signal_count: int = 0  # mapped signals of the measurements


class Ring(NamedTuple):
    """Views into one shared block."""

    header: np.ndarray  # (WORD_COUNT * HEADER_STRIDE,) int64; word w is header[w * HEADER_STRIDE]
    tick: np.ndarray  # (tick_capacity,) records.TICK
    command: np.ndarray  # (tick_capacity * axis_count,) records.COMMAND
    state: np.ndarray  # (tick_capacity * axis_count,) records.STATE
    miss: np.ndarray  # (miss_capacity,) records.MISS
    can: np.ndarray  # (can_capacity,) records.can_frame_record(can_data_size)
    histogram: np.ndarray  # (histogram_count, bucket_count) int64, stored by the loop, read wait-free
    extreme: np.ndarray  # (histogram_count, 4) int64: min, max, sum, count
    frame_count: np.ndarray  # (axis_count + 1, status.FRAME_STATUS_COUNT) int64; last row: no axis
    clamped_count: (
        np.ndarray
    )  # (sent_signal_count,) int64: times a signal could not carry its value; at least one entry


def _parts(shape: RingShape) -> list[tuple[str, np.dtype, tuple[int, ...]]]:
    axes = shape.axis_count
    return [
        ("header", np.dtype("i8"), (WORD_COUNT * HEADER_STRIDE,)),
        ("tick", records.TICK, (shape.tick_capacity,)),
        ("command", records.COMMAND, (shape.tick_capacity * axes,)),
        ("state", records.STATE, (shape.tick_capacity * axes,)),
        ("miss", records.MISS, (shape.miss_capacity,)),
        ("can", records.can_frame_record(shape.can_data_size), (shape.can_capacity,)),
        ("histogram", np.dtype("i8"), (shape.histogram_count, shape.bucket_count)),
        ("extreme", np.dtype("i8"), (shape.histogram_count, 4)),
        ("frame_count", np.dtype("i8"), (axes + 1, status.FRAME_STATUS_COUNT)),
        ("clamped_count", np.dtype("i8"), (max(shape.sent_signal_count, 1),)),
    ]


def size_bytes(shape: RingShape) -> int:
    """Bytes of shared memory a ring of this shape needs; every part starts on a 64-byte line."""
    return sum(-(-dtype.itemsize * int(np.prod(dims)) // 64) * 64 for _, dtype, dims in _parts(shape))


def view(buffer, shape: RingShape) -> Ring:
    """The arrays of a ring in `buffer` (shared memory or bytearray), contents untouched."""
    arrays = {}
    offset = 0
    for name, dtype, dims in _parts(shape):
        count = int(np.prod(dims))
        arrays[name] = np.frombuffer(buffer, dtype, count, offset).reshape(dims)
        offset += -(-dtype.itemsize * count // 64) * 64
    return Ring(**arrays)


def initialise(ring: Ring, shape: RingShape) -> None:
    """Zero everything, write CDR headers and the sizes; the producer's duty, before the recorder attaches."""
    for array in ring:
        array.view("u1")[...] = 0
    for name in ("tick", "command", "state", "miss", "can"):
        getattr(ring, name)["cdr"] = records.CDR_HEADER
    words = {
        WORD_AXIS_COUNT: shape.axis_count,
        WORD_TICK_CAPACITY: shape.tick_capacity,
        WORD_MISS_CAPACITY: shape.miss_capacity,
        WORD_CAN_CAPACITY: shape.can_capacity,
        WORD_CAN_DATA_SIZE: shape.can_data_size,
        WORD_MAGIC: MAGIC,
    }
    for word, value in words.items():
        ring.header[word * HEADER_STRIDE] = value


def log_lacks(ring: Ring) -> list[str]:
    """What the log lacks, as far as its recorder has found, in sentences; for cold code."""
    bits = word(ring, WORD_LOG_LACKS)
    return [text for bit, text in enumerate(LOG_LACKS_TEXTS) if bits >> bit & 1]


def word(ring: Ring, index: int) -> int:
    """One header word, for cold code."""
    return int(ring.header[index * HEADER_STRIDE])
