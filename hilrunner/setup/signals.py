"""A database and a mapping become the flat tables of realtime.decode and realtime.encode.

The mapping (setup.mapping) says which message and signal carries which quantity; identifiers, bits, byte order, scale, unit, range,
cycle time, start values and end-to-end protection come from the database. Commands are built by `command_table`, measurements by
`measurement_table`; what they share is here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.base.units import NS_PER_MS
from hilrunner.realtime import decode, encode
from hilrunner.setup.command_table import command_messages, command_table
from hilrunner.setup.database import load_database
from hilrunner.setup.mapping import (
    MAX_COUNTER_DELTA,
    AxisMapping,
    CommandMapping,
    MeasurementMapping,
    Protection,
    SignalMapping,
    default_mapping,
)
from hilrunner.setup.measurement_table import SentSignal, measurement_table
from hilrunner.setup.quantities import CONTROL_NAMES, QUANTITY_KINDS
from hilrunner.setup.wire_facts import ID_FLAGS, FrameFacts, can_id, is_fd

__all__ = [
    "CONTROL_NAMES",
    "MAX_COUNTER_DELTA",
    "QUANTITY_KINDS",
    "AxisMapping",
    "CommandMapping",
    "MeasurementMapping",
    "Protection",
    "SignalMapping",
    "default_mapping",
]
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


@dataclass
class Wiring:
    """A mapping as it was understood: the tables of the loop, and what a person wants to know of them."""

    commands: decode.CommandTable
    measurements: encode.MeasurementTable
    sent: list[SentSignal]  # one a row of measurements.signals
    received_facts: list[FrameFacts]  # one a row of commands.frames
    sent_facts: list[FrameFacts]  # one a message the bench sends
    described: dict[str, object]  # cantools messages by the names of the mapping's own


def load_signals(
    dbc_path: str | Path,
    mapping: list[AxisMapping],
    period_ns: int = NS_PER_MS,
    fd: bool = True,
    read_own: Callable[[str], bytes] | None = None,
) -> tuple[decode.CommandTable, encode.MeasurementTable]:
    """Read the database and build both tables, read-only; arguments and errors as of `wire`."""
    wiring = wire(dbc_path, mapping, period_ns, fd, read_own)
    return wiring.commands, wiring.measurements


def wire(
    dbc_path: str | Path,
    mapping: list[AxisMapping],
    period_ns: int = NS_PER_MS,
    fd: bool = True,
    read_own: Callable[[str], bytes] | None = None,
    stale_after_ms: list[float] | None = None,
) -> Wiring:
    """Read the database and understand the mapping.

    Args:
        mapping: one entry an axis, in the order of the profile's axes.
        period_ns: of the loop; cycle times become whole numbers of periods, at least one.
        fd: whether the bus carries CAN FD frames; if not, a mapped FD message is refused.
        read_own: the bytes of a file with a protection of the user's own; None: read beside the database.
        stale_after_ms: of every axis, for messages that may be older than the command.

    Raises:
        DbcError: no such file, message or signal; a unit or range that cannot carry the quantity; bits used twice.
    """
    path = Path(dbc_path)
    database = load_database(path)
    place, read_own = path.name, read_own or (lambda name: (path.parent / name).read_bytes())
    commands = [axis.command for axis in mapping]
    stale = stale_after_ms or [0.0] * len(mapping)
    try:
        _check_messages(place, database, mapping, fd)
        command, received_facts = command_table(place, database, commands, read_own, period_ns, stale)
        measurement, sent, sent_facts = measurement_table(place, database, mapping, period_ns, read_own)
    except (ArithmeticError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        # what has a check of its own above says more; a file of a stranger can hold anything in the place of a number
        raise DbcError(
            place,
            f"a mapped message holds what cannot be used ({type(error).__name__}: {error})",
            "numbers where the format has numbers",
            "export it again",
        ) from error
    names = {facts.name for facts in (*received_facts, *sent_facts)}
    described = {message.name: message for message in reversed(database.messages) if message.name in names}
    return Wiring(_frozen(command), _frozen(measurement), sent, received_facts, sent_facts, described)


def _check_messages(place: str, database, mapping: list[AxisMapping], fd: bool) -> None:
    """Every mapped message exists, goes one way, and has a length the bus can carry."""
    from hilrunner.setup.database import find_message

    received = {name for axis in mapping for name in command_messages(axis.command)}
    sent = {entry.message for axis in mapping for entry in axis.measurements}
    ways: dict[int, tuple[str, str]] = {}
    for name, way in [(name, "received") for name in sorted(received)] + [(name, "sent") for name in sorted(sent)]:
        message = find_message(place, database, name)
        known = ways.setdefault(can_id(message), (name, way))
        if known != (name, way):
            raise DbcError(
                f"{place}: {name}", f"identifier 0x{message.frame_id:x} is mapped twice (also as {known[0]}, {known[1]})",
                "one message of an identifier, one direction", "map another message",
            )  # fmt: skip
        if is_fd(message) and not fd:
            raise DbcError(
                f"{place}: {name}", f"is a CAN FD message ({message.length} bytes), the bus is classic",
                "8 data bytes", "set `fd = true` in the profile's [can]",
            )  # fmt: skip
        if not 1 <= message.length <= 8 and message.length not in FD_LENGTHS:
            raise DbcError(
                f"{place}: {name}", f"{message.length} data bytes", "1..8, or 12 16 20 24 32 48 64 (ISO 11898-1)"
            )


def _frozen(table):
    for part in table:
        if isinstance(part, np.ndarray):
            part.setflags(write=False)
    return table


assert len(QUANTITY_KINDS) == encode.QUANTITY_COUNT and tuple(QUANTITY_KINDS) == encode.QUANTITY_NAMES
assert [CONTROL_NAMES.index(name) for name in ("disabled", "hold", "active", "reset", "trip")] == [
    status.CONTROL_DISABLED, status.CONTROL_HOLD, status.CONTROL_ACTIVE, status.CONTROL_RESET, status.CONTROL_TRIP,
]  # fmt: skip
assert ID_FLAGS == decode.CAN_EFF_FLAG
