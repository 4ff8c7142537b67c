"""A DBC and a mapping become the integer tables of realtime.decode and realtime.encode.

The mapping (setup.mapping) says which message and signal carries which quantity; ids, bits, byte order, scale, unit, range, cycle
time, start values and end-to-end protection come from the DBC.
"""

from fractions import Fraction
from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.base.units import NS_PER_MS, WIRE_UNITS
from hilrunner.realtime import bits, decode, e2e, encode
from hilrunner.setup import signal_layout
from hilrunner.setup.database import find_message, load_database
from hilrunner.setup.mapping import (
    MAX_COUNTER_DELTA,
    AxisMapping,
    CommandMapping,
    MeasurementMapping,
    Protection,
    SignalMapping,
    default_mapping,
)
from hilrunner.setup.start_values import start_image

__all__ = ["AxisMapping", "CommandMapping", "MeasurementMapping", "Protection", "SignalMapping", "default_mapping"]

QUANTITY_KINDS = {
    "chamber_1_pressure": "pressure",
    "chamber_2_pressure": "pressure",
    "supply_pressure": "pressure",
    "line_a_pressure": "pressure",
    "line_b_pressure": "pressure",
    "rod_position": "length",
    "rod_velocity": "velocity",
    "spool_1_position": "length",
    "spool_2_position": "length",
    "load_force": "force",
    "valve_command": "ratio",
    "bench_state": "count",
    "flags": "count",
    "tick": "count",
    "deadline_misses": "count",
    "echoed_timestamp": "timestamp",
    "heave_position": "length",
    "heave_velocity": "velocity",
}
CONTROL_NAMES = ("disabled", "hold", "active", "reset")
LONGEST_CYCLE_MS = 3_600_000
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


def load_signals(
    dbc_path: str | Path, mapping: list[AxisMapping], period_ns: int = NS_PER_MS, fd: bool = True
) -> tuple[decode.CommandTable, encode.MeasurementTable]:
    """Read the DBC and build both tables, read-only.

    Args:
        mapping: one entry an axis, in the order of the profile's axes.
        period_ns: of the loop; cycle times become whole numbers of periods, at least one.
        fd: whether the bus carries CAN FD frames; if not, a mapped FD message is refused.

    Raises:
        DbcError: no such file, message or signal; a unit or range that cannot carry the quantity; two uses of one message.
    """
    database = load_database(Path(dbc_path))
    place = Path(dbc_path).name
    try:
        _check_messages(place, database, mapping, fd)
        return (
            _command_table(place, database, [axis.command for axis in mapping]),
            _measurement_table(place, database, mapping, period_ns),
        )
    except (ArithmeticError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        # what has a check of its own above says more; a file of a stranger can hold anything in the place of a number
        raise DbcError(
            place,
            f"a mapped message holds what cannot be used ({type(error).__name__}: {error})",
            "numbers where the DBC format has numbers",
            "export it again",
        ) from error


def _check_messages(place: str, database, mapping: list[AxisMapping], fd: bool) -> None:
    """Every mapped message exists, is mapped once, and has a length the bus can carry."""
    used: dict[int, str] = {}
    for axis in mapping:
        for name in [axis.command.message] + [entry.message for entry in axis.measurements]:
            message = find_message(place, database, name)
            if _can_id(message) in used:
                raise DbcError(
                    f"{place}: {name}", f"identifier 0x{message.frame_id:x} is mapped twice (also as {used[_can_id(message)]})",
                    "one message, one axis, one direction", "give each axis messages of its own",
                )  # fmt: skip
            used[_can_id(message)] = name
            if _is_fd(message) and not fd:
                raise DbcError(
                    f"{place}: {name}", f"is a CAN FD message ({message.length} bytes), the bus is classic",
                    "8 data bytes", "set `fd = true` in the profile's [can]",
                )  # fmt: skip
            if not 1 <= message.length <= 8 and message.length not in FD_LENGTHS:
                raise DbcError(
                    f"{place}: {name}", f"{message.length} data bytes", "1..8, or 12 16 20 24 32 48 64 (ISO 11898-1)"
                )


def _is_fd(message) -> bool:
    return bool(message.is_fd) or message.length > 8


def _can_id(message) -> int:
    return message.frame_id | (decode.CAN_EFF_FLAG if message.is_extended_frame else 0)


def _data_ids(place: str, message, protection: Protection | str) -> np.ndarray | None:
    """The 16 Data IDs of a protected message, None for an unprotected one."""
    if protection == "none":
        return None
    if isinstance(protection, Protection):
        values = protection.data_id_list
    else:
        attributes = message.dbc.attributes if message.dbc else {}
        profile = attributes["E2EProfile"].value if "E2EProfile" in attributes else ""
        if not profile:
            return None
        if profile != "P02":
            raise DbcError(f"{place}: {message.name}", f"E2EProfile '{profile}' is not known", "P02")
        try:
            values = [int(word) for word in attributes["E2EDataIdList"].value.replace(",", " ").split()]
        except (KeyError, ValueError) as error:
            raise DbcError(
                f"{place}: {message.name}", f"E2EDataIdList cannot be read ({error})", "16 numbers 0..255"
            ) from error
    if len(values) != e2e.COUNTER_MODULUS or not all(0 <= value <= 255 for value in values):
        raise DbcError(f"{place}: {message.name}", f"Data ID list {values} does not fit", "16 numbers 0..255")
    if message.length < 2:
        raise DbcError(f"{place}: {message.name}", f"{message.length} bytes cannot hold P02", "2 bytes or more")
    return np.array(values, np.uint8)


def _row(place: str, message, mapped: str | SignalMapping, kind: str, modulus: bool = False) -> np.ndarray:
    """One bits.SIGNAL row for a mapped signal."""
    mapped = SignalMapping(mapped) if isinstance(mapped, str) else mapped
    signal = signal_layout.find(place, message, mapped.signal)
    where = f"{place}: {message.name}.{signal.name}"
    if mapped.factor is not None:
        factor = Fraction(str(mapped.factor))
    else:
        unit = (signal.unit or "") if mapped.unit is None else mapped.unit
        if unit not in WIRE_UNITS[kind]:
            raise DbcError(
                where, f"unit '{unit}' is not one of a {kind}",
                ", ".join(f"'{name}'" for name in WIRE_UNITS[kind]), "give `unit` or `factor` in the mapping",
            )  # fmt: skip
        factor = Fraction(WIRE_UNITS[kind][unit])
    return signal_layout.row(where, signal, factor, modulus, mapped.range)


def _command_table(place: str, database, commands: list[CommandMapping]) -> decode.CommandTable:
    count = len(commands)
    rows: list[np.ndarray] = []
    table = decode.CommandTable(
        can_id=np.zeros(count, np.uint32),
        length=np.zeros(count, np.int64),
        protected=np.zeros(count, np.uint8),
        data_ids=np.zeros((count, e2e.COUNTER_MODULUS), np.uint8),
        max_counter_delta=np.full(count, MAX_COUNTER_DELTA, np.int64),
        valve_signal=np.zeros(count, np.int64),
        control_signal=np.full(count, decode.NO_SIGNAL, np.int64),
        timestamp_signal=np.full(count, decode.NO_SIGNAL, np.int64),
        control_number=np.tile(np.arange(decode.CONTROL_COUNT, dtype=np.float64), (count, 1)),
        signals=np.zeros(0, bits.SIGNAL),
    )
    for axis, command in enumerate(commands):
        message = find_message(place, database, command.message)
        ids = _data_ids(place, message, command.protection)
        if not 1 <= command.max_counter_delta <= 14:
            raise DbcError(
                f"{place}: {message.name}", f"max_counter_delta {command.max_counter_delta} does not fit", "1..14"
            )
        table.can_id[axis] = _can_id(message)
        table.length[axis] = message.length
        table.max_counter_delta[axis] = command.max_counter_delta
        if ids is not None:
            table.protected[axis] = 1
            table.data_ids[axis] = ids
        first = len(rows)
        table.valve_signal[axis] = first
        rows.append(_valve_row(place, message, command.valve_command))
        if command.control is not None:
            table.control_signal[axis] = len(rows)
            rows.append(_row(place, message, SignalMapping(command.control, factor=1.0), "count"))
            _fill_controls(place, message, command, table.control_number[axis])
        if command.timestamp is not None:
            table.timestamp_signal[axis] = len(rows)
            rows.append(_timestamp_row(place, message, command.timestamp))
        signal_layout.check_room(f"{place}: {message.name}", message.length, rows[first:], ids is not None)
    return _frozen(table._replace(signals=np.array(rows, bits.SIGNAL).reshape(len(rows))))


def _valve_row(place: str, message, mapped: str | SignalMapping) -> np.ndarray:
    """The row of the valve command, its range cut to -1..1."""
    row = _row(place, message, mapped, "ratio")
    ends = sorted((end - row["offset"]) / row["scale"] for end in (-1.0, 1.0))
    row["number_min"] = max(row["number_min"], ends[0])
    row["number_max"] = min(row["number_max"], ends[1])
    if not row["number_min"] < row["number_max"]:
        raise DbcError(f"{place}: {message.name}", "the range of the valve command holds nothing between -1 and 1")
    return row


def _timestamp_row(place: str, message, mapped: str | SignalMapping) -> np.ndarray:
    row = _row(place, message, mapped, "timestamp")
    whole = float(row["scale"]).is_integer() and row["scale"] >= 1 and row["offset"] == 0
    if row["kind"] != bits.KIND_UNSIGNED or not whole:
        raise DbcError(
            f"{place}: {message.name}", "the time stamp must be unsigned and count whole microseconds",
            remedy="leave `timestamp` out of the mapping",
        )  # fmt: skip
    return row


def _fill_controls(place: str, message, command: CommandMapping, numbers: np.ndarray) -> None:
    """Raw value of each control word; NaN for one that is not in use."""
    if command.control_values is None:
        return
    if len(set(command.control_values.values())) != len(command.control_values):
        raise DbcError(f"{place}: {message.name}", f"control_values {command.control_values}: one value twice")
    numbers[:] = np.nan
    for name, value in command.control_values.items():
        numbers[CONTROL_NAMES.index(name)] = value


def _measurement_table(place: str, database, mapping: list[AxisMapping], period_ns: int) -> encode.MeasurementTable:
    entries = [(axis, entry) for axis, mapped in enumerate(mapping) for entry in mapped.measurements]
    count = len(entries)
    rows: list[np.ndarray] = []
    quantities: list[int] = []
    table = encode.MeasurementTable(
        message_count=count,
        axis=np.array([axis for axis, _ in entries], np.int64),
        can_id=np.zeros(count, np.uint32),
        length=np.zeros(count, np.int64),
        fd=np.zeros(count, np.uint8),
        period_ticks=np.ones(count, np.int64),
        phase=np.zeros(count, np.int64),
        protected=np.zeros(count, np.uint8),
        data_ids=np.zeros((count, e2e.COUNTER_MODULUS), np.uint8),
        template=np.zeros((count, encode.DATA_SIZE_MAX), np.uint8),
        signal_first=np.zeros(count, np.int64),
        signal_count=np.zeros(count, np.int64),
        quantity=np.zeros(0, np.int64),
        signals=np.zeros(0, bits.SIGNAL),
    )
    for index, (_, entry) in enumerate(entries):
        message = find_message(place, database, entry.message)
        ids = _data_ids(place, message, entry.protection)
        table.can_id[index] = _can_id(message)
        table.length[index] = message.length
        table.fd[index] = 1 if _is_fd(message) else 0
        table.period_ticks[index] = _period_ticks(place, message, entry.cycle_ms, period_ns)
        table.phase[index] = index % table.period_ticks[index]
        if ids is not None:
            table.protected[index] = 1
            table.data_ids[index] = ids
        table.template[index] = start_image(message)
        table.signal_first[index] = len(rows)
        for name, mapped in entry.signals.items():
            if name not in encode.QUANTITY_NAMES:
                raise DbcError(f"{place}: {message.name}", f"no quantity '{name}'", ", ".join(encode.QUANTITY_NAMES))
            quantity = encode.QUANTITY_NAMES.index(name)
            rows.append(_row(place, message, mapped, QUANTITY_KINDS[name], quantity in encode.WRAPPING_QUANTITIES))
            quantities.append(quantity)
        table.signal_count[index] = len(rows) - table.signal_first[index]
        signal_layout.check_room(
            f"{place}: {message.name}", message.length, rows[table.signal_first[index] :], ids is not None
        )
    return _frozen(
        table._replace(quantity=np.array(quantities, np.int64), signals=np.array(rows, bits.SIGNAL).reshape(len(rows)))
    )


def _period_ticks(place: str, message, cycle_ms: float | None, period_ns: int) -> int:
    """Cycle time in periods: the nearest whole number, at least 1; a cycle of 0 or none means every period."""
    cycle = message.cycle_time if cycle_ms is None else cycle_ms
    if cycle is not None and not 0 <= cycle <= LONGEST_CYCLE_MS:
        raise DbcError(
            f"{place}: {message.name}",
            f"a cycle time of {cycle} ms",
            f"0 to {LONGEST_CYCLE_MS} ms",
            "correct GenMsgCycleTime",
        )
    return max(1, round((cycle or 0) * NS_PER_MS / period_ns))


def _frozen(table):
    for part in table:
        if isinstance(part, np.ndarray):
            part.setflags(write=False)
    return table


assert len(QUANTITY_KINDS) == encode.QUANTITY_COUNT and tuple(QUANTITY_KINDS) == encode.QUANTITY_NAMES
assert [status.CONTROL_DISABLED, status.CONTROL_HOLD, status.CONTROL_ACTIVE, status.CONTROL_RESET] == [0, 1, 2, 3]
