"""Blocks of several topics become one stretch of message records in order of log time."""

import struct

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base import records
from hilrunner.record import chunk


def in_order(blocks):
    """The same, one message at a time."""
    rows = [
        (int(message["log_real_ns"]), block.messages[i : i + 1].tobytes())
        for block in blocks
        for i, message in enumerate(block.messages)
    ]
    return b"".join(raw for _, raw in sorted(rows, key=lambda row: row[0]))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=12), min_size=1, max_size=6))
def test_assembling_equals_sorting_single_messages(times_of_blocks):
    layouts = [records.TICK, records.COMMAND, records.STATE]
    blocks = []
    for number, times in enumerate(times_of_blocks):
        payload = records.allocate(layouts[number % 3], len(times))
        payload["tick"] = np.arange(len(times)) + 100 * number
        blocks.append(chunk.build_block(number % 3 + 1, 0, payload, np.array(times), np.zeros(len(times))))
    data, pairs = chunk.assemble(blocks)
    assert data.tobytes() == in_order(blocks)
    for channel, index in pairs.items():
        for log_ns, offset in index.tolist():
            opcode, _, found, _, found_ns = struct.unpack_from("<BQHIQ", data, offset)
            assert (opcode, found, found_ns) == (5, channel, log_ns)
    assert sum(map(len, pairs.values())) == sum(map(len, times_of_blocks))


def test_a_message_record_is_built_as_the_specification_draws_it():
    payload = records.allocate(records.COMMAND, 2)
    payload["tick"] = [7, 8]
    block = chunk.build_block(3, 0xFFFFFFFF, payload, np.array([11, 12]), np.array([9, 10]))
    size = records.COMMAND.itemsize - 4
    assert block.messages[0].tobytes() == struct.pack("<BQHIQQ", 5, 22 + size, 3, 0xFFFFFFFF, 11, 9) + bytes(
        payload[0].tobytes()[4:]
    )
    assert block.messages["sequence"].tolist() == [0xFFFFFFFF, 0]  # the counter of the format has 32 bits
