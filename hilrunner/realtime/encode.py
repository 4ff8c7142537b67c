"""Measurements of an axis become the bytes of a message: scaled, rounded, clamped, protected.

One row of `quantities` an axis holds everything a message may carry, in SI; which signal carries what is data.
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base.compiled import hot
from hilrunner.realtime import bits, e2e, protection
from hilrunner.realtime.curve import interpolate

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


UNPROTECTED, PROTECTED_P02, PROTECTED_BY_GUARD = range(3)

# What fills a signal, one row a row of `signals`.
SOURCE = np.dtype([("axis", "i2"), ("quantity", "i2"), ("curve_first", "i2"), ("curve_count", "i2")], align=True)


class MeasurementTable(NamedTuple):
    """Messages the bench sends, as flat arrays, one entry a message; made by setup.measurement_table, read-only.

    The pages of a multiplexed message are entries of their own, sent in turns; they share a stream of counters.
    """

    message_count: int
    stream: np.ndarray  # i8[message], entry of the counters
    axes: np.ndarray  # i8[message], bit k: it carries a quantity of axis k
    can_id: np.ndarray  # u4[message], with the EFF flag for 29-bit identifiers
    length: np.ndarray  # i8[message], data bytes
    fd: np.ndarray  # u1[message], 0: classic, 1: CAN FD, 3: CAN FD with bit-rate switch
    period_ticks: np.ndarray  # i8[message], sent on ticks where tick % period_ticks == phase
    phase: np.ndarray  # i8[message], spreads slow messages over the ticks
    protected: np.ndarray  # u1[message], UNPROTECTED, PROTECTED_P02, PROTECTED_BY_GUARD
    data_ids: np.ndarray  # u1[message, 16], of profile 2
    guard: np.ndarray  # i8[message], row of `guards`
    checksum_byte: np.ndarray  # i8[message], data byte that a bad checksum is injected into
    counter_start: np.ndarray  # i8[message], counter before the first frame
    template: np.ndarray  # u1[message, 64], start values of the signals nobody fills
    signal_first: np.ndarray  # i8[message], first row of `signals`
    signal_count: np.ndarray  # i8[message]
    source: np.ndarray  # SOURCE[signal]
    signals: np.ndarray  # bits.SIGNAL[signal]
    curve_x: np.ndarray  # f8[...], points of curves: quantity in SI …
    curve_y: np.ndarray  # f8[...], … and the physical value that is sent
    guards: np.ndarray  # checksum.GUARD[...]
    guard_signals: np.ndarray  # bits.SIGNAL[...] of counters and checksums

    @property
    def quantity(self) -> np.ndarray:
        """QUANTITY_* of every signal; for cold code."""
        return self.source["quantity"]


def no_quantities(axis_count: int) -> np.ndarray:
    """A zeroed `quantities` array: f8[axis, QUANTITY_COUNT]."""
    return np.zeros((axis_count, QUANTITY_COUNT))


def send_counters(table: MeasurementTable) -> np.ndarray:
    """Counters before the first frame: i8[message], used by stream; with E2E profile 2 the first frame carries 1."""
    return table.counter_start.copy()


@hot
def encode_measurement(table, message, quantities, counter, clamped, data):
    """Fill the data bytes of one message.

    Args:
        table: MeasurementTable. message: index. quantities: f8[axis, QUANTITY_COUNT], read.
        counter: i8[message], last sent alive counters by stream, this message's one is moved on.
        clamped: i8[signal], one more for each signal whose value does not fit and is sent as the nearest one that does.
        data: u1[64], written up to the message's length.

    Returns:
        The message's length in bytes.
    """
    length = table.length[message]
    for index in range(length):
        data[index] = table.template[message, index]
    first = table.signal_first[message]
    for index in range(first, first + table.signal_count[message]):
        source = table.source[index]
        value = quantities[np.int64(source["axis"]), np.int64(source["quantity"])]
        beyond = False
        if source["curve_count"] > 0:
            value, beyond = _by_curve(table, source, value)
        if bits.encode_si(table.signals, index, value, data) or beyond:
            clamped[index] += 1
    if table.protected[message] == PROTECTED_P02:
        stream = table.stream[message]
        counter[stream] = (counter[stream] + 1) % e2e.COUNTER_MODULUS
        e2e.protect_p02(data, length, table.data_ids[message], counter[stream])
    elif table.protected[message] == PROTECTED_BY_GUARD:
        stream = table.stream[message]
        counter[stream] = protection.protect(
            table.guards, table.guard[message], table.guard_signals, data, length, counter[stream]
        )
    return length


@hot
def _by_curve(table, source, value):
    """(physical value to send, whether the value lies beyond the curve's ends)."""
    first, count = np.int64(source["curve_first"]), np.int64(source["curve_count"])
    if np.isnan(value):
        return value, False
    beyond = value < table.curve_x[first] or value > table.curve_x[first + count - 1]
    return interpolate(table.curve_x, table.curve_y, first, count, value), beyond
