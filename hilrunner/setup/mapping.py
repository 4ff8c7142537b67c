"""What a profile says of the bus: which message and signal carries which quantity. The structs below are the format.

Identifiers, bits, byte order, scale, unit, range, cycle time, start values and end-to-end protection come from the database; a key of
the mapping takes the place of what the database says. docs/mapping.md shows how each of them is used. `default_mapping` is the mapping of
firmware_iface/actuator.dbc.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

MAX_COUNTER_DELTA = 3  # two frames in a row may be lost
HEAVE_MESSAGE = "HEAVE"  # came later than the others: the DBC of an older log has none
_CYCLE_MS_MAX = 3_600_000.0
_LARGEST = 2**63 - 1

Name = Annotated[str, Meta(min_length=1, max_length=128)]
Physical = Annotated[float, Meta(ge=-1e15, le=1e15)]
Raw = Annotated[int, Meta(ge=-(2**63), le=_LARGEST)]
Byte = Annotated[int, Meta(ge=0, le=255)]
Whole = Annotated[int, Meta(ge=0, le=_LARGEST)]
# A number as it stands on the wire, or the name that the database's value table gives it; a list means any of them.
Value = Raw | Name
Values = Raw | Name | Annotated[list[Value], Meta(max_length=256)]
Point = tuple[Physical, Physical]


def _told(kind: Any, meaning: str, **bounds: Any) -> Any:
    """A type with the sentence that docs/profiles.md prints of its key."""
    return Annotated[kind, Meta(description=meaning, **bounds)]


_SIGNAL = "its name in the database"
_ELSEWHERE = "where the signal stands in another message than the command's own"


class SignalMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal, where more has to be said than its name."""

    signal: _told(Name, _SIGNAL)
    message: _told(Name | None, _ELSEWHERE) = None
    unit: _told(Name | None, "in place of the database's unit; with a curve: the unit of its second column") = None
    factor: _told(Physical | None, "physical value times factor is SI; in place of both units") = None
    scale: _told(Physical | None, "physical value = raw value times scale + offset, in place of the database's") = None
    offset: _told(Physical | None, "see `scale`") = None
    range: _told(
        tuple[Physical, Physical] | None,
        "lowest and highest physical value in place of the database's; 0, 0: all that the bits hold",
    ) = None
    curve: _told(
        Annotated[list[Point], Meta(max_length=256)] | None,
        "points [physical value, quantity in `unit`], straight lines between them; a sent signal takes the inverse",
    ) = None
    deadband: _told(Physical | None, "commands: physical value up to which the valve stays shut") = None
    full: _told(Physical | None, "commands: physical value of the fully open valve") = None
    values: _told(
        Annotated[dict[Name, Value], Meta(max_length=32)] | None, "bench_state: name of the bench's state = value sent"
    ) = None
    other: _told(Value | None, "bench_state: value of all states that `values` does not name") = None


class DirectionMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The signal that says which way a magnitude goes; another value than those named refuses the frame's command."""

    signal: _told(Name, _SIGNAL)
    message: _told(Name | None, _ELSEWHERE) = None
    extend: _told(Values | None, "values, or names of the value table, that extend the rod") = None
    retract: _told(Values | None, "values that retract it") = None
    block: _told(Values | None, "values that put the valve in neutral") = None
    float: _told(
        Values | None, "values that open both ports to tank: neutral too, the counterbalance valves hold the load"
    ) = None


class LineMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A line of the machine: on or off.

    With `on` every other value is off, with `off` every other value is on; with both, any other value refuses the frame's command.
    Without either, `enable` and `reset` are on at 1 and `dump` and `safety` are off at 0, so that a value nobody thought of is the safe one.
    """

    signal: _told(Name, _SIGNAL)
    message: _told(Name | None, _ELSEWHERE) = None
    on: _told(Values | None, "values at which the line is on") = None
    off: _told(Values | None, "values at which it is off") = None


class Protection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Counter and checksum of a message whose database does not declare them."""

    profile: _told(
        Literal["P01", "P02", "P04", "P05", "P06", "P07", "P11", "J1939", "plain"] | None,
        "an AUTOSAR E2E profile, SAE J1939 (TSC1), or `plain`: counter and checksum as the keys below say, the default",
    ) = None
    data_id_list: _told(
        list[Byte], "P02, plain: bytes that are not sent, one a counter value, behind the data", max_length=16
    ) = []
    data_id: _told(Annotated[int, Meta(ge=0, le=0xFFFFFFFF)] | None, "Data ID of the other AUTOSAR profiles") = None
    data_id_mode: _told(
        Literal["both", "low", "alternating", "nibble"], "which bytes of the Data ID P01 and P11 cover"
    ) = "both"
    offset_bytes: _told(int, "first byte of the profile's header", ge=0, le=63) = 0
    counter: _told(Name | None, "signal that counts the frames") = None
    counter_modulus: _told(
        Annotated[int, Meta(ge=2, le=_LARGEST)] | None, "the counter runs 0 to modulus - 1; default: all its bits"
    ) = None
    counter_first: _told(Whole | None, "counter of the first frame that is sent") = None
    checksum: _told(Name | None, "signal that carries the checksum") = None
    algorithm: _told(
        Name | None, "`sum`, `xor`, `nibble-sum`, or the name of a CRC such as `CRC-8/SAE-J1850`; default: sum"
    ) = None
    polynomial: _told(Annotated[int, Meta(ge=1, le=_LARGEST)] | None, "of a CRC that has no name") = None
    start: _told(Whole | None, "first value of the register or the sum") = None
    reflect_in: _told(bool, "of a CRC that has no name: lowest bit of each byte first") = False
    reflect_out: _told(bool, "of a CRC that has no name: its bits in the other order") = False
    final_xor: _told(Whole | None, "what the result is combined with by exclusive or") = None
    negated: _told(bool, "sums: the two's complement of the sum") = False
    first_byte: _told(int, "first byte covered; the checksum's own are left out", ge=0, le=63) = 0
    last_byte: _told(Annotated[int, Meta(ge=0, le=63)] | None, "last byte covered; default: of the message") = None
    own_bits: _told(
        Literal["skipped", "zero"] | None,
        "how the checksum's own bits are covered; default: skipped where they fill whole bytes, else as zeros",
    ) = None
    include: _told(
        list[Literal["id", "length"]],
        "covered before the data: identifier (2 or 4 bytes, highest first), length (1 byte)",
        max_length=2,
    ) = []
    before: _told(list[Byte], "bytes covered before the data though not sent", max_length=8) = []
    after: _told(list[Byte], "bytes covered after the data though not sent", max_length=8) = []


_PROTECTION = "`dbc`: as the database's attributes say; `none`; `file.py:function`; or a table, see below"
_DELTA = "largest step of the counter that is no loss of too many frames"


class FrameMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a further message of a command is judged."""

    message: _told(Name, "its name, or its identifier as `0x18FE3021`")
    protection: _told(Protection | Name, _PROTECTION) = "dbc"
    max_counter_delta: _told(int, _DELTA, ge=1, le=_LARGEST) = MAX_COUNTER_DELTA
    stale_after_ms: _told(
        Annotated[float, Meta(gt=0, le=_CYCLE_MS_MAX)] | None,
        "how old this message may be before the command counts as stale; default: as the axis' own",
    ) = None


class CommandMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message or messages that carry an axis' valve command.

    The command comes in one of three forms: `valve_command`; `magnitude` with `direction`; `current_a` and `current_b`. Without
    `control` every valid frame counts as Active, and a latched fail-safe lasts to the end of the run unless a `reset` line ends it.
    """

    message: _told(Name, "its name, or its identifier as `0x18FE3021`; other axes may use the same")
    valve_command: _told(Name | SignalMapping | None, "signal with the command, -1 to 1 in SI, positive extends") = None
    magnitude: _told(Name | SignalMapping | None, "signal with the opening, 0 to 1 in SI") = None
    direction: _told(Name | DirectionMapping | None, "signal that says which way the magnitude goes") = None
    current_a: _told(Name | SignalMapping | None, "current of the solenoid that extends; needs `full` or `curve`") = (
        None
    )
    current_b: _told(Name | SignalMapping | None, "current of the solenoid that retracts") = None
    control: _told(Name | SignalMapping | None, "signal with the control word") = None
    control_values: _told(
        dict[Literal["disabled", "hold", "active", "reset", "trip"], Values] | None,
        "value of each control word; without it 0, 1, 2, 3 for disabled, hold, active, reset",
    ) = None
    timestamp: _told(Name | SignalMapping | None, "signal whose value is sent back as `echoed_timestamp`") = None
    enable: _told(Name | LineMapping | None, "line; off: Disabled") = None
    dump: _told(Name | LineMapping | None, "line; on: the pump is unloaded, Hold") = None
    safety: _told(Name | LineMapping | None, "line; on: latched fail-safe") = None
    reset: _told(Name | LineMapping | None, "line; on: Reset") = None
    protection: _told(Protection | Name, _PROTECTION) = "dbc"
    max_counter_delta: _told(int, _DELTA, ge=1, le=_LARGEST) = MAX_COUNTER_DELTA
    frames: _told(
        list[FrameMapping], "further messages, where their protection or age is not the default", max_length=32
    ) = []


class MeasurementMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A message the bench sends; other axes may map signals of the same message."""

    message: _told(Name, "its name, or its identifier as `0x18FE3021`")
    signals: _told(
        dict[str, Name | SignalMapping | Annotated[list[Name | SignalMapping], Meta(max_length=8)]],
        "measured quantity = signal, or a list of signals that carry it; the quantities below",
        max_length=64,
    ) = {}
    constants: _told(
        dict[Name, Physical | Name], "signal = physical value or name, in place of its start value", max_length=64
    ) = {}
    cycle_ms: _told(Annotated[float, Meta(gt=0, le=_CYCLE_MS_MAX)] | None, "in place of the database's cycle time") = (
        None
    )
    protection: _told(Protection | Name, _PROTECTION) = "dbc"


class AxisMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The messages of one axis."""

    command: _told(CommandMapping, "the message or messages that carry the valve command")
    measurements: _told(list[MeasurementMapping], "the messages the bench sends", max_length=64)


def as_mapping(mapped: str | SignalMapping) -> SignalMapping:
    """A signal given by its name alone, in full."""
    return SignalMapping(mapped) if isinstance(mapped, str) else mapped


def default_mapping(axis_count: int = 1, with_heave: bool = True) -> list[AxisMapping]:
    """The mapping of firmware_iface/actuator.dbc for axes 1..axis_count.

    Args:
        with_heave: whether the DBC has the messages HEAVE_k, which one that was written before them has not.
    """
    return [_default_axis(number, with_heave) for number in range(1, axis_count + 1)]


def _default_axis(number: int, with_heave: bool) -> AxisMapping:
    heave = MeasurementMapping(
        f"{HEAVE_MESSAGE}_{number}",
        {"heave_position": "heave_position_mm", "heave_velocity": "heave_velocity_mmps"},
    )
    return AxisMapping(
        command=CommandMapping(
            f"VALVE_COMMAND_{number}", valve_command="valve_setpoint", control="control", timestamp="timestamp_us"
        ),
        measurements=[
            MeasurementMapping(
                f"PRESSURES_{number}",
                {
                    "chamber_1_pressure": "chamber_1_pressure_kpa",
                    "chamber_2_pressure": "chamber_2_pressure_kpa",
                    "supply_pressure": "supply_pressure_kpa",
                },
            ),
            MeasurementMapping(
                f"MOTION_{number}", {"rod_position": "rod_position_mm", "rod_velocity": "rod_velocity_mmps"}
            ),
            MeasurementMapping(
                f"BENCH_STATUS_{number}",
                {
                    "bench_state": "bench_state",
                    "flags": "flags",
                    "deadline_misses": "deadline_misses",
                    "tick": "tick",
                    "echoed_timestamp": "echoed_timestamp_us",
                },
            ),
            *([heave] if with_heave else []),
        ],
    )
