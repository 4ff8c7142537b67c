"""Compiled walk over MCAP records: find every message, copy payloads into record arrays.

A record is opcode (1 byte), content length (8 bytes), content. A message's content is channel id (2), sequence (4),
log time (8), publish time (8), data. All little-endian (MCAP specification, "Records").
"""

import numpy as np

from hilrunner.base.compiled import entry, hot

OPCODE_FOOTER = 0x02
OPCODE_SCHEMA = 0x03
OPCODE_CHANNEL = 0x04
OPCODE_MESSAGE = 0x05
OPCODE_CHUNK = 0x06
OPCODE_ATTACHMENT = 0x09
OPCODE_STATISTICS = 0x0B
OPCODE_METADATA = 0x0C
OPCODE_DATA_END = 0x0F

RECORD_HEADER_BYTES = 9
MESSAGE_HEADER_BYTES = 22

WALK_DONE = 0  # reached the end exactly
WALK_CUT = 1  # the last record is longer than what is there
WALK_STOPPED = 2  # a record other than a message stands at `position`
WALK_FULL = 3  # the message table is full

MESSAGE = np.dtype(
    [("offset", "i8"), ("size", "i8"), ("log_time_ns", "i8"), ("publish_time_ns", "i8"), ("channel", "i8")]
)  # offset and size of the data in the buffer


@hot
def _unsigned(buffer, position, count):
    value = np.uint64(0)
    for index in range(count):
        value |= np.uint64(buffer[position + index]) << np.uint64(8 * index)
    return value


@entry
def walk(buffer, position, end, messages, count):
    """Note messages from `position` on until another record, the end, or a cut.

    Args:
        buffer: u1[n], read.
        position, end: bytes to look at, `end` <= n.
        messages: MESSAGE[m], written from `count` on.
        count: entries already there.

    Returns (code WALK_*, position of the first byte not taken, entries now there).
    """
    size = end
    while position < size:
        if size - position < RECORD_HEADER_BYTES:
            return WALK_CUT, position, count
        length = _unsigned(buffer, position + 1, 8)
        if buffer[position] != OPCODE_MESSAGE:
            return WALK_STOPPED, position, count
        start = position + RECORD_HEADER_BYTES
        if length > np.uint64(size - start):
            return WALK_CUT, position, count
        content = np.int64(length)
        if content < MESSAGE_HEADER_BYTES:
            return WALK_STOPPED, position, count
        if count == messages.shape[0]:
            return WALK_FULL, position, count
        entry_ = messages[count]
        entry_["channel"] = np.int64(_unsigned(buffer, start, 2))
        entry_["log_time_ns"] = np.int64(_unsigned(buffer, start + 6, 8))
        entry_["publish_time_ns"] = np.int64(_unsigned(buffer, start + 14, 8))
        entry_["offset"] = start + MESSAGE_HEADER_BYTES
        entry_["size"] = content - MESSAGE_HEADER_BYTES
        count += 1
        position = start + content
    return WALK_DONE, position, count


@entry
def gather(buffer, messages, channel, size, spans, target):
    """Copy parts of the payloads of one channel that have the expected size, in order.

    Args:
        buffer: u1[n], read.
        messages: MESSAGE[m], read.
        channel: channel id.
        size: expected payload bytes.
        spans: int64[s, 3], read: first byte in the payload, byte count, first byte in the row.
        target: u1[k, row size], written; k at least the channel's messages.

    Returns (rows written, messages of another size).
    """
    row = 0
    other = 0
    for index in range(messages.shape[0]):
        if messages[index]["channel"] != channel:
            continue
        if messages[index]["size"] != size:
            other += 1
            continue
        offset = messages[index]["offset"]
        for span in range(spans.shape[0]):
            source = offset + spans[span, 0]
            place = spans[span, 2]
            for byte in range(spans[span, 1]):
                target[row, place + byte] = buffer[source + byte]
        row += 1
    return row, other


@entry
def decode_lz4_blocks(source, end, position, checksummed, target):
    """Decode the blocks of an LZ4 frame as far as the source reaches, also inside a block.

    Args:
        source: u1[n], read: the frame's bytes.
        end: bytes of `source` to use.
        position: where the first block's size word stands.
        checksummed: blocks are followed by a 4-byte checksum.
        target: u1[m], written; also the window of linked blocks.

    Returns the bytes written. Source: LZ4 frame format 1.6, LZ4 block format.
    """
    out = 0
    limit = target.shape[0]
    while position + 4 <= end:
        word = _unsigned(source, position, 4)
        position += 4
        if word == 0:
            return out
        size = np.int64(word & np.uint64(0x7FFFFFFF))
        block_end = min(position + size, end)
        if word >> np.uint64(31):
            count = min(block_end - position, limit - out)
            for index in range(count):
                target[out + index] = source[position + index]
            out += count
        else:
            out = _decode_lz4_block(source, position, block_end, target, out)
        position += size + (4 if checksummed else 0)
    return out


@hot
def _decode_lz4_block(source, position, end, target, out):
    limit = target.shape[0]
    while position < end:
        token = np.int64(source[position])
        position += 1
        literal_count = token >> 4
        if literal_count == 15:
            more = 255
            while more == 255 and position < end:
                more = np.int64(source[position])
                position += 1
                literal_count += more
        count = min(literal_count, end - position, limit - out)
        for index in range(count):
            target[out + index] = source[position + index]
        out += count
        position += count
        if count < literal_count or position + 2 > end:
            return out
        distance = np.int64(source[position]) | (np.int64(source[position + 1]) << 8)
        position += 2
        match_count = (token & 15) + 4
        if match_count == 19:
            more = 255
            while more == 255 and position < end:
                more = np.int64(source[position])
                position += 1
                match_count += more
        if distance == 0 or distance > out:
            return out
        count = min(match_count, limit - out)
        for index in range(count):
            target[out + index] = target[out + index - distance]
        out += count
        if count < match_count:
            return out
    return out
