"""Message records of an MCAP chunk, built a block at a time.

A block is a structured array whose items *are* MCAP message records (opcode, length, channel, sequence, times, data), so
that a thousand messages cost a few array assignments. `assemble` puts the blocks of several topics in order of log time.
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base import records

OPCODE_MESSAGE = 5
MESSAGE_HEAD_SIZE_BYTES = 9 + 22  # opcode and length; channel, sequence, log time, publish time
INDEX_PAIR = np.dtype([("log_real_ns", "<u8"), ("offset", "<u8")])


class Block(NamedTuple):
    """Messages of one channel, in order."""

    channel: int
    messages: np.ndarray  # (n,) message_dtype


def message_dtype(data_size_bytes: int) -> np.dtype:
    """Layout of one MCAP message record with a payload of fixed size; no padding."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_real_ns", "<u8"),
            ("publish_real_ns", "<u8"),
            ("data", f"V{data_size_bytes}"),
        ]
    )


def build_block(channel: int, sequence: int, payload: np.ndarray, log_real_ns, publish_real_ns) -> Block:
    """Message records of `payload` (n,) of base.records layouts; times (n,) int64 ns since the Unix epoch.

    The payload's unused first bytes are left out; sequence numbers count up from `sequence`.
    """
    count = len(payload)
    data = _without_prefix(payload)
    size = data.dtype.itemsize
    messages = np.empty(count, message_dtype(size))
    messages["opcode"] = OPCODE_MESSAGE
    messages["length"] = 22 + size
    messages["channel"] = channel
    messages["sequence"] = np.arange(sequence, sequence + count).astype(np.uint32)  # the format counts modulo 2**32
    messages["log_real_ns"] = log_real_ns
    messages["publish_real_ns"] = publish_real_ns
    messages["data"] = data
    return Block(channel, messages)


def _without_prefix(payload: np.ndarray) -> np.ndarray:
    """A view of records from the CDR header on, as opaque bytes; opaque bytes stay as they are."""
    if payload.dtype.kind == "V" and payload.dtype.names is None:
        return payload
    size = payload.dtype.itemsize - records.MESSAGE_OFFSET
    raw = np.ascontiguousarray(payload).view(np.uint8)
    return np.ndarray(payload.shape, f"V{size}", raw, records.MESSAGE_OFFSET, (payload.dtype.itemsize,))


def assemble(blocks: list[Block]) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """The bytes of a chunk in order of log time (stable), and for each channel its (log time, offset) pairs."""
    sizes = np.concatenate([np.full(len(b.messages), b.messages.dtype.itemsize, np.int64) for b in blocks])
    times = np.concatenate([b.messages["log_real_ns"] for b in blocks])
    order = np.argsort(times, kind="stable")
    ends = np.cumsum(sizes[order])
    total = int(ends[-1])
    offsets = np.empty(len(order), np.int64)
    offsets[order] = ends - sizes[order]
    out = np.empty(total, np.uint8)
    pairs: dict[int, list[np.ndarray]] = {}
    start = 0
    for channel, messages in blocks:
        stop = start + len(messages)
        # one item at every byte position: assigning through it copies whole messages to any offset
        item = f"V{messages.dtype.itemsize}"
        anywhere = np.ndarray((total - messages.dtype.itemsize + 1,), item, out, strides=(1,))
        anywhere[offsets[start:stop]] = messages.view(item)
        index = np.empty(len(messages), INDEX_PAIR)
        index["log_real_ns"] = messages["log_real_ns"]
        index["offset"] = offsets[start:stop]
        pairs.setdefault(channel, []).append(index)
        start = stop
    return out, {channel: np.concatenate(parts) for channel, parts in pairs.items()}
