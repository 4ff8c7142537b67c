"""A received frame becomes a checked valve command, or a status; nothing of a rejected frame is used.

Goals: a bad frame changes nothing here; the caller counts it by its status. Checks in order: error frame, remote
frame, identifier, length, CRC, counter, NaN and range, control word. The first that fails is the status.

Counter rule (E2E profile 2, MaxDeltaCounter from the mapping, SyncCounterInit 1):
- the first frame of a stream is accepted whatever its counter;
- a step of 1..max_counter_delta is accepted, a step of 0 is FRAME_REPEATED_COUNTER;
- a larger step is FRAME_LOST_COUNTER: the frame is not used, but its counter becomes the last counter, so a firmware
  that restarts anywhere in the sequence loses exactly one frame. It is the only rejected frame that moves
  `last_counter`: the standard's resynchronisation, without which such a stream could stay out for good.
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import hot
from hilrunner.realtime import bits, e2e

# flags of struct can_frame.can_id, linux/can.h
CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
CAN_ERR_FLAG = 0x20000000
NO_AXIS = -1
NO_SIGNAL = -1
CONTROL_COUNT = 4

# The newest valid command of an axis; written by decode_command only.
FRESH = np.dtype(
    [
        ("valve_command", "f8"),  # -1..1, positive extends
        ("timestamp_us", "u4"),  # the sender's clock; 0 if the message has none
        ("control", "u1"),  # status.CONTROL_*
        ("counter", "u1"),  # alive counter; 0 if the message has none
    ],
    align=True,
)


class CommandTable(NamedTuple):
    """Valve commands of all axes as flat arrays, one entry an axis; made by setup.signals, read-only."""

    can_id: np.ndarray  # u4[axis], with CAN_EFF_FLAG for 29-bit identifiers
    length: np.ndarray  # i8[axis], data bytes
    protected: np.ndarray  # u1[axis], 1: E2E profile 2
    data_ids: np.ndarray  # u1[axis, 16]
    max_counter_delta: np.ndarray  # i8[axis], 1..14
    valve_signal: np.ndarray  # i8[axis], row of `signals`
    control_signal: np.ndarray  # i8[axis], NO_SIGNAL: the message is always Active
    timestamp_signal: np.ndarray  # i8[axis], NO_SIGNAL: none
    control_number: np.ndarray  # f8[axis, 4], number on the wire of Disabled, Hold, Active, Reset; NaN: not in use
    signals: np.ndarray  # bits.SIGNAL[...]


def fresh_commands(axis_count: int) -> np.ndarray:
    """One zeroed FRESH entry an axis."""
    return np.zeros(axis_count, FRESH)


def no_counters(axis_count: int) -> np.ndarray:
    """`last_counter` of streams that have not begun: i8[axis]."""
    return np.full(axis_count, e2e.NO_COUNTER, np.int64)


@hot
def _find_axis(table, can_id):
    for axis in range(table.can_id.shape[0]):
        if np.int64(table.can_id[axis]) == can_id:
            return axis
    return NO_AXIS


@hot
def _check_protection(table, axis, data, last_counter):
    """status.FRAME_* of CRC and counter; moves last_counter only to resynchronise."""
    counter = e2e.counter_p02(data)
    if e2e.crc_p02(data, table.length[axis], table.data_ids[axis, counter]) != np.int64(data[0]):
        return status.FRAME_BAD_CRC
    if last_counter[axis] == e2e.NO_COUNTER:
        return status.FRAME_VALID
    step = e2e.counter_step(counter, last_counter[axis])
    if step == 0:
        return status.FRAME_REPEATED_COUNTER
    if step > table.max_counter_delta[axis]:
        last_counter[axis] = counter
        return status.FRAME_LOST_COUNTER
    return status.FRAME_VALID


@hot
def _control_of(table, axis, data):
    """status.CONTROL_* of the message, or -1 if the control word is none of the mapped ones."""
    if table.control_signal[axis] == NO_SIGNAL:
        return status.CONTROL_ACTIVE
    number = bits.decode_number(table.signals, table.control_signal[axis], data)
    for control in range(CONTROL_COUNT):
        if table.control_number[axis, control] == number:
            return control
    return -1


@hot
def _timestamp_of(table, axis, data):
    """Sender's time in microseconds modulo 2**32, 0 if the message has none."""
    index = table.timestamp_signal[axis]
    if index == NO_SIGNAL:
        return np.uint64(0)
    ticks = bits.extract_bits(table.signals, index, data)
    return (ticks * np.uint64(table.signals[index]["scale"])) & np.uint64(0xFFFFFFFF)


@hot
def decode_command(table, can_id, length, data, last_counter, fresh):
    """Check one frame and take its command.

    Args:
        table: CommandTable. can_id: as in struct can_frame, with EFF, RTR and ERR flags. length: data bytes of the frame.
        data: u1[>= 64], read (bytes beyond `length` are never looked at).
        last_counter: i8[axis], counter of the last accepted frame, NO_COUNTER at first; read and written.
        fresh: FRESH[axis], written only if the frame is valid.

    Returns:
        (axis, status.FRAME_*); axis is NO_AXIS if the frame belongs to none. Cost: one pass over the data bytes.
    """
    can_id = np.int64(can_id)
    if can_id & CAN_ERR_FLAG:
        return NO_AXIS, status.FRAME_ERROR
    axis = _find_axis(table, can_id & ~CAN_RTR_FLAG)
    if can_id & CAN_RTR_FLAG:
        return axis, status.FRAME_REMOTE
    if axis == NO_AXIS:
        return axis, status.FRAME_UNKNOWN_ID
    if length != table.length[axis]:
        return axis, status.FRAME_WRONG_LENGTH
    protected = table.protected[axis] != 0
    if protected:
        code = _check_protection(table, axis, data, last_counter)
        if code != status.FRAME_VALID:
            return axis, code
    index = table.valve_signal[axis]
    number = bits.decode_number(table.signals, index, data)
    if np.isnan(number):
        return axis, status.FRAME_NOT_A_NUMBER
    if number < table.signals[index]["number_min"] or number > table.signals[index]["number_max"]:
        return axis, status.FRAME_OUT_OF_RANGE
    control = _control_of(table, axis, data)
    if control < 0:
        return axis, status.FRAME_BAD_CONTROL
    counter = e2e.counter_p02(data) if protected else 0
    if protected:
        last_counter[axis] = counter
    fresh[axis]["valve_command"] = number * table.signals[index]["scale"] + table.signals[index]["offset"]
    fresh[axis]["timestamp_us"] = np.uint32(_timestamp_of(table, axis, data))
    fresh[axis]["control"] = np.uint8(control)
    fresh[axis]["counter"] = np.uint8(counter)
    return axis, status.FRAME_VALID
