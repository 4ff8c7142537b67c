"""A received frame becomes checked valve commands, or a status; nothing of a rejected frame is used.

Goals: a bad frame changes nothing here; the caller counts it by its status. Checks of the frame, in order: error frame, remote
frame, identifier, length, checksum, counter. Then each *group* of it, one axis' part of the frame, by itself: NaN and range, tables of
values (control words, directions, lines). The first check that fails is the status.

An axis may take its command from several groups: of several frames, or of several pages of a multiplexed one. Its command is
then as old as the oldest of them, and none before all have come.

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
from hilrunner.base.compiled import entry, hot
from hilrunner.base.records import FRAME_STATUS_NONE
from hilrunner.realtime import bits, e2e, protection
from hilrunner.realtime.curve import interpolate

# flags of struct can_frame.can_id, linux/can.h
CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
CAN_ERR_FLAG = 0x20000000
NO_AXIS = -1
NO_FRAME = -1
NEVER = -1  # group_tick of a group that has not come yet

UNPROTECTED, PROTECTED_P02, PROTECTED_BY_GUARD = range(3)

# What a field of a frame means to its axis; index into a row of `input`.
(
    INPUT_SETPOINT,  # 0..1 or -1..1: valve command, magnitude, or what the current of edge A asks for
    INPUT_OPPOSED,  # 0..1, what the current of edge B asks for: taken off
    INPUT_DIRECTION,  # 1 extend, -1 retract, 0 block
    INPUT_CONTROL,  # status.CONTROL_*
    INPUT_TIMESTAMP,  # us, of the sender's clock
    INPUT_ENABLE,  # lines: 0 off, 1 on
    INPUT_DUMP,
    INPUT_SAFETY,
    INPUT_RESET,
    INPUT_COUNT,
) = range(10)

# One row a message: where it belongs and how it is protected.
FRAME = np.dtype(
    [
        ("can_id", "u4"),  # with CAN_EFF_FLAG for 29-bit identifiers
        ("id_mask", "u4"),  # bits of the identifier that count
        ("length", "i2"),  # data bytes
        ("group_first", "i2"),  # rows of `groups`
        ("group_count", "i2"),
        ("guard", "i2"),  # row of `guards`, where protected by one
        ("max_counter_delta", "i2"),  # of profile 2, 1..14
        ("protected", "u1"),  # UNPROTECTED, PROTECTED_P02, PROTECTED_BY_GUARD
        ("data_ids", "u1", (e2e.COUNTER_MODULUS,)),  # of profile 2
    ],
    align=True,
)

# One row an axis' part of a message (of one page of it, where it is multiplexed).
GROUP = np.dtype(
    [
        ("axis", "i2"),
        ("field_first", "i2"),  # rows of `fields`, and the same of `signals`
        ("field_count", "i2"),
        ("condition_first", "i2"),  # rows of `conditions`: the page
        ("condition_count", "i2"),
        ("shared", "i2"),  # 1: the axis has other groups too
        ("grace_ticks", "i8"),  # how much older than the axis' command this part may be
    ],
    align=True,
)

# One row a signal of a group; `signals` has the same rows.
FIELD = np.dtype(
    [
        ("role", "i2"),  # INPUT_*
        ("is_listed", "i2"),  # 1: the number is looked up in the tables of values
        ("value_first", "i2"),
        ("value_count", "i2"),
        ("curve_first", "i2"),
        ("curve_count", "i2"),  # 0: no curve
        ("other", "f4"),  # what a number that is not listed means; NaN: it is refused
    ],
    align=True,
)

# A page of a multiplexed message is there when this signal carries one of these numbers.
CONDITION = np.dtype([("signal", "i2"), ("value_first", "i2"), ("value_count", "i2")], align=True)

# The newest valid command of an axis; written by take_group only.
FRESH = np.dtype(
    [
        ("valve_command", "f8"),  # -1..1, positive extends
        ("valid_tick", "i8"),  # tick of the oldest frame it is made of
        ("timestamp_us", "u4"),  # the sender's clock; 0 if the message has none
        ("control", "u1"),  # status.CONTROL_*
        ("counter", "u1"),  # alive counter, its low byte; 0 if the message has none
    ],
    align=True,
)


class CommandTable(NamedTuple):
    """The messages that carry commands, as flat arrays; made by setup.command_table, read-only."""

    frames: np.ndarray  # FRAME[message]
    groups: np.ndarray  # GROUP[...]
    fields: np.ndarray  # FIELD[...]
    conditions: np.ndarray  # CONDITION[...]
    signals: np.ndarray  # bits.SIGNAL[...]; first the fields', then the conditions'
    value_number: np.ndarray  # f8[...], numbers on the wire …
    value_meaning: np.ndarray  # f8[...], … and what they mean
    curve_x: np.ndarray  # f8[...], points of curves: physical value …
    curve_y: np.ndarray  # f8[...], … and what it asks for
    guards: np.ndarray  # checksum.GUARD[...]
    guard_signals: np.ndarray  # bits.SIGNAL[...] of counters and checksums

    @property
    def can_id(self) -> np.ndarray:
        """Identifiers of the messages, u4[message]; for cold code."""
        return self.frames["can_id"]

    @property
    def length(self) -> np.ndarray:
        """Data bytes of the messages; for cold code."""
        return self.frames["length"]

    @property
    def protected(self) -> np.ndarray:
        """How the messages are protected; for cold code."""
        return self.frames["protected"]

    @property
    def data_ids(self) -> np.ndarray:
        """Data IDs of profile 2, u1[message, 16]; for cold code."""
        return self.frames["data_ids"]


class Receiver(NamedTuple):
    """What a receiver keeps between frames, and its scratch; a Bench has the same names."""

    last_counter: np.ndarray  # i8[message]: counter of the newest accepted frame, NO_COUNTER: none
    input: np.ndarray  # f8[axis, INPUT_COUNT]: newest accepted value of each role
    group_tick: np.ndarray  # i8[group]: tick of the newest accepted frame, NEVER
    fresh: np.ndarray  # FRESH[axis]
    field_value: np.ndarray  # f8[fields]: scratch
    group_status: np.ndarray  # i8[group]: scratch, status.FRAME_* or FRAME_STATUS_NONE


def fresh_commands(axis_count: int) -> np.ndarray:
    """One zeroed FRESH entry an axis."""
    return np.zeros(axis_count, FRESH)


def no_counters(message_count: int) -> np.ndarray:
    """`last_counter` of streams that have not begun: i8[message]."""
    return np.full(message_count, e2e.NO_COUNTER, np.int64)


def no_input(axis_count: int) -> np.ndarray:
    """`input` before any frame: extending, active, enabled, neither dumped nor tripped."""
    rows = np.zeros((axis_count, INPUT_COUNT))
    rows[:, INPUT_DIRECTION] = 1.0
    rows[:, INPUT_CONTROL] = status.CONTROL_ACTIVE
    rows[:, INPUT_ENABLE] = 1.0
    return rows


def new_receiver(table: CommandTable, axis_count: int) -> Receiver:
    """A receiver that has seen no frame."""
    return Receiver(
        last_counter=no_counters(len(table.frames)),
        input=no_input(axis_count),
        group_tick=np.full(len(table.groups), NEVER, np.int64),
        fresh=fresh_commands(axis_count),
        field_value=np.zeros(max(len(table.fields), 1)),
        group_status=np.zeros(max(len(table.groups), 1), np.int64),
    )


@hot
def _find_frame(table, can_id):
    for frame in range(table.frames.shape[0]):
        row = table.frames[frame]
        if np.int64(row["can_id"]) == can_id & np.int64(row["id_mask"]):
            return frame
    return NO_FRAME


@hot
def _check_p02(row, data, last_counter):
    """(status.FRAME_*, counter) of a frame of profile 2."""
    counter = e2e.counter_p02(data)
    if e2e.crc_p02(data, np.int64(row["length"]), row["data_ids"][counter]) != np.int64(data[0]):
        return np.int64(status.FRAME_BAD_CRC), counter
    if last_counter == e2e.NO_COUNTER:
        return np.int64(status.FRAME_VALID), counter
    step = e2e.counter_step(counter, last_counter)
    if step == 0:
        return np.int64(status.FRAME_REPEATED_COUNTER), counter
    if step > row["max_counter_delta"]:
        return np.int64(status.FRAME_LOST_COUNTER), counter
    return np.int64(status.FRAME_VALID), counter


@hot
def check_frame(table, can_id, length, data, receiver):
    """Everything that is judged of a frame as a whole.

    Args:
        can_id: as in struct can_frame, with EFF, RTR and ERR flags. length: data bytes of the frame.
        data: u1[>= 64]; bytes beyond `length` are never looked at. receiver: last_counter is moved to resynchronise only.

    Returns:
        (message or NO_FRAME, status.FRAME_*, counter). Cost: one pass over the data bytes.
    """
    can_id = np.int64(can_id)
    if can_id & CAN_ERR_FLAG:
        return NO_FRAME, np.int64(status.FRAME_ERROR), np.int64(0)
    frame = _find_frame(table, can_id & ~CAN_RTR_FLAG)
    if can_id & CAN_RTR_FLAG:
        return frame, np.int64(status.FRAME_REMOTE), np.int64(0)
    if frame == NO_FRAME:
        return frame, np.int64(status.FRAME_UNKNOWN_ID), np.int64(0)
    row = table.frames[frame]
    if length != row["length"]:
        return frame, np.int64(status.FRAME_WRONG_LENGTH), np.int64(0)
    if row["protected"] == UNPROTECTED:
        return frame, np.int64(status.FRAME_VALID), np.int64(0)
    last_counter = receiver.last_counter[frame]
    if row["protected"] == PROTECTED_P02:
        code, counter = _check_p02(row, data, last_counter)
    else:
        guard = np.int64(row["guard"])
        code, counter = protection.judge(table.guards, guard, table.guard_signals, data, length, last_counter)
    if code == status.FRAME_LOST_COUNTER:
        receiver.last_counter[frame] = counter
    return frame, code, counter


@hot
def _meaning_of(table, first, count, number, other):
    for at in range(first, first + count):
        if table.value_number[at] == number:
            return table.value_meaning[at]
    return np.float64(other)


@hot
def _is_present(table, group, data):
    """Whether a frame carries the page that a group belongs to."""
    first = np.int64(group["condition_first"])
    for at in range(first, first + np.int64(group["condition_count"])):
        condition = table.conditions[at]
        number = bits.decode_number(table.signals, np.int64(condition["signal"]), data)
        found = False
        value = np.int64(condition["value_first"])
        for k in range(value, value + np.int64(condition["value_count"])):
            found = found or table.value_number[k] == number
        if not found:
            return False
    return True


@hot
def _timestamp_of(table, at, data):
    """Sender's time in microseconds modulo 2**32."""
    ticks = bits.extract_bits(table.signals, at, data)
    return np.float64((ticks * np.uint64(table.signals[at]["scale"])) & np.uint64(0xFFFFFFFF))


@hot
def _read_field(table, at, data):
    """(status.FRAME_*, value) of one field."""
    field = table.fields[at]
    if field["role"] == INPUT_TIMESTAMP:
        return np.int64(status.FRAME_VALID), _timestamp_of(table, at, data)
    number = bits.decode_number(table.signals, at, data)
    if field["is_listed"] != 0:
        first, count = np.int64(field["value_first"]), np.int64(field["value_count"])
        meaning = _meaning_of(table, first, count, number, field["other"])
        code = status.FRAME_BAD_CONTROL if np.isnan(meaning) else status.FRAME_VALID
        return np.int64(code), meaning
    row = table.signals[at]
    if np.isnan(number):
        return np.int64(status.FRAME_NOT_A_NUMBER), number
    if number < row["number_min"] or number > row["number_max"]:
        return np.int64(status.FRAME_OUT_OF_RANGE), number
    value = number * row["scale"] + row["offset"]
    if field["curve_count"] > 0:
        first, count = np.int64(field["curve_first"]), np.int64(field["curve_count"])
        value = interpolate(table.curve_x, table.curve_y, first, count, value)
    return np.int64(status.FRAME_VALID), value


@hot
def read_group(table, group, data, receiver):
    """Read one axis' part of a frame that is right as a whole into field_value; nothing else is written.

    Returns status.FRAME_*, or FRAME_STATUS_NONE where the frame carries another page.
    """
    row = table.groups[group]
    if row["condition_count"] > 0 and not _is_present(table, row, data):
        return np.int64(FRAME_STATUS_NONE)
    first = np.int64(row["field_first"])
    for at in range(first, first + np.int64(row["field_count"])):
        code, value = _read_field(table, at, data)
        if code != status.FRAME_VALID:
            return code
        receiver.field_value[at] = value
    return np.int64(status.FRAME_VALID)


@hot
def _oldest_tick(table, axis, receiver, tick):
    """Tick of the oldest part of an axis' command; NEVER until all have come."""
    oldest = tick
    for group in range(table.groups.shape[0]):
        row = table.groups[group]
        if row["axis"] == axis:
            seen = receiver.group_tick[group]
            if seen == NEVER:
                return np.int64(NEVER)
            oldest = min(oldest, seen + row["grace_ticks"])
    return oldest


@hot
def _control_of(inputs):
    """The control word with the lines: what stops the valve goes before what moves it."""
    if inputs[INPUT_SAFETY] != 0.0:
        return status.CONTROL_TRIP
    if inputs[INPUT_RESET] != 0.0:
        return status.CONTROL_RESET
    if inputs[INPUT_ENABLE] == 0.0:
        return status.CONTROL_DISABLED
    if inputs[INPUT_DUMP] != 0.0 and inputs[INPUT_CONTROL] == status.CONTROL_ACTIVE:
        return status.CONTROL_HOLD
    return np.int64(inputs[INPUT_CONTROL])


@hot
def take_group(table, group, tick, counter, receiver):
    """Take what read_group has read; True when the axis has a new command, which then is in `fresh`."""
    row = table.groups[group]
    axis = np.int64(row["axis"])
    inputs = receiver.input[axis]
    first = np.int64(row["field_first"])
    for at in range(first, first + np.int64(row["field_count"])):
        inputs[np.int64(table.fields[at]["role"])] = receiver.field_value[at]
    receiver.group_tick[group] = tick
    valid_tick = np.int64(tick)
    if row["shared"] != 0:
        valid_tick = _oldest_tick(table, axis, receiver, valid_tick)
        if valid_tick == NEVER:
            return False
    fresh = receiver.fresh[axis]
    fresh["valve_command"] = (inputs[INPUT_SETPOINT] - inputs[INPUT_OPPOSED]) * inputs[INPUT_DIRECTION]
    fresh["valid_tick"] = valid_tick
    fresh["timestamp_us"] = np.uint32(inputs[INPUT_TIMESTAMP])
    fresh["control"] = np.uint8(_control_of(inputs))
    fresh["counter"] = np.uint8(counter & 0xFF)
    return True


@hot
def accept_counter(table, frame, counter, receiver):
    """Move the counter of a stream on: by a frame of which a part was right, or of which no part is mapped."""
    if table.frames[frame]["protected"] != UNPROTECTED:
        receiver.last_counter[frame] = counter


@entry  # for readers of logs, which call it from Python
def decode_command(table, can_id, length, data, tick, receiver):
    """Check one frame and take its commands.

    Args:
        table: CommandTable. can_id, length, data: as in check_frame. tick: when it came.
        receiver: Receiver; `fresh` of an axis is written only where its part of the frame is valid, and group_status
            of each part says what became of it.

    Returns:
        (axis, status.FRAME_*) of the first part that is not right, or of the first; axis is NO_AXIS if the frame belongs to none.
    """
    frame, code, counter = check_frame(table, can_id, length, data, receiver)
    if frame == NO_FRAME:
        return np.int64(NO_AXIS), code
    row = table.frames[frame]
    first, count = np.int64(row["group_first"]), np.int64(row["group_count"])
    axis = np.int64(table.groups[first]["axis"])
    good = np.int64(0)
    bad = np.int64(0)
    worst = code
    for group in range(first, first + count):
        outcome = code
        if code == status.FRAME_VALID:
            outcome = read_group(table, group, data, receiver)
        receiver.group_status[group] = outcome
        if outcome == status.FRAME_VALID:
            take_group(table, group, tick, counter, receiver)
            good += 1
        elif outcome != FRAME_STATUS_NONE:
            if bad == 0:
                worst = outcome
                axis = np.int64(table.groups[group]["axis"])
            bad += 1
    if good > 0 or bad == 0:
        accept_counter(table, frame, counter, receiver)
    return axis, worst
