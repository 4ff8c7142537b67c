"""Measurements of an axis become the bytes of a message: scaled, rounded, clamped, protected.

One row of `quantities` an axis holds everything a message may carry, in SI; which signal carries what is data.
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base.compiled import hot
from hilrunner.realtime import bits, e2e

(
    QUANTITY_CHAMBER_1_PRESSURE,  # Pa gauge
    QUANTITY_CHAMBER_2_PRESSURE,
    QUANTITY_SUPPLY_PRESSURE,
    QUANTITY_LINE_A_PRESSURE,
    QUANTITY_LINE_B_PRESSURE,
    QUANTITY_ROD_POSITION,  # m
    QUANTITY_ROD_VELOCITY,  # m/s
    QUANTITY_SPOOL_1_POSITION,  # m
    QUANTITY_SPOOL_2_POSITION,
    QUANTITY_LOAD_FORCE,  # N
    QUANTITY_VALVE_COMMAND,  # -1..1, as applied to the plant
    QUANTITY_BENCH_STATE,  # status.MODE_*
    QUANTITY_FLAGS,  # status.FLAG_*
    QUANTITY_TICK,  # period number; wraps at the signal's width
    QUANTITY_DEADLINE_MISSES,  # stays at the signal's maximum
    QUANTITY_ECHOED_TIMESTAMP,  # us of the sender's clock; wraps at the signal's width
    QUANTITY_HEAVE_POSITION,  # m, heave of the vessel, positive upwards; 0 without a wave
    QUANTITY_HEAVE_VELOCITY,  # m/s
    QUANTITY_COUNT,
) = range(19)

QUANTITY_NAMES = (
    "chamber_1_pressure",
    "chamber_2_pressure",
    "supply_pressure",
    "line_a_pressure",
    "line_b_pressure",
    "rod_position",
    "rod_velocity",
    "spool_1_position",
    "spool_2_position",
    "load_force",
    "valve_command",
    "bench_state",
    "flags",
    "tick",
    "deadline_misses",
    "echoed_timestamp",
    "heave_position",
    "heave_velocity",
)
WRAPPING_QUANTITIES = (QUANTITY_TICK, QUANTITY_ECHOED_TIMESTAMP)
DATA_SIZE_MAX = 64


class MeasurementTable(NamedTuple):
    """Messages the bench sends, as flat arrays, one entry a message; made by setup.signals, read-only."""

    message_count: int
    axis: np.ndarray  # i8[message]
    can_id: np.ndarray  # u4[message], with the EFF flag for 29-bit identifiers
    length: np.ndarray  # i8[message], data bytes
    fd: np.ndarray  # u1[message], 1: CAN FD
    period_ticks: np.ndarray  # i8[message], sent on ticks where tick % period_ticks == phase
    phase: np.ndarray  # i8[message], spreads slow messages over the ticks
    protected: np.ndarray  # u1[message], 1: E2E profile 2
    data_ids: np.ndarray  # u1[message, 16]
    template: np.ndarray  # u1[message, 64], start values of the signals nobody fills
    signal_first: np.ndarray  # i8[message], first row of `signals`
    signal_count: np.ndarray  # i8[message]
    quantity: np.ndarray  # i8[signal], QUANTITY_*
    signals: np.ndarray  # bits.SIGNAL[signal]


def no_quantities(axis_count: int) -> np.ndarray:
    """A zeroed `quantities` array: f8[axis, QUANTITY_COUNT]."""
    return np.zeros((axis_count, QUANTITY_COUNT))


def send_counters(table: MeasurementTable) -> np.ndarray:
    """Counters before the first frame: i8[message]; the first frame carries 1, as E2E profile 2 has it."""
    return np.zeros(table.message_count, np.int64)


@hot
def encode_measurement(table, message, quantities, counter, clamped, data):
    """Fill the data bytes of one message.

    Args:
        table: MeasurementTable. message: index. quantities: f8[axis, QUANTITY_COUNT], read.
        counter: i8[message], last sent alive counters, this message's one is moved on.
        clamped: i8[signal], one more for each signal whose value does not fit and is sent as the nearest one that does.
        data: u1[64], written up to the message's length.

    Returns:
        The message's length in bytes.
    """
    length = table.length[message]
    for index in range(length):
        data[index] = table.template[message, index]
    axis = table.axis[message]
    first = table.signal_first[message]
    for index in range(first, first + table.signal_count[message]):
        if bits.encode_si(table.signals, index, quantities[axis, table.quantity[index]], data):
            clamped[index] += 1
    if table.protected[message] != 0:
        counter[message] = (counter[message] + 1) % e2e.COUNTER_MODULUS
        e2e.protect_p02(data, length, table.data_ids[message], counter[message])
    return length
