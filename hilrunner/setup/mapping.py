"""What a profile says of the bus: which message and signal carries which quantity. The structs below are the format.

Identifiers, bits, byte order, scale, unit, range, cycle time, start values and end-to-end protection come from the DBC; a key of
the mapping takes the place of what the DBC says. `default_mapping` is the mapping of firmware_iface/actuator.dbc.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

MAX_COUNTER_DELTA = 3  # two frames in a row may be lost
HEAVE_MESSAGE = "HEAVE"  # came later than the others: the DBC of an older log has none


Name = Annotated[str, Meta(min_length=1, max_length=128)]
Physical = Annotated[float, Meta(ge=-1e15, le=1e15)]
Raw = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_CYCLE_MS_MAX = 3_600_000.0


class SignalMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal.

    `unit` replaces the DBC's unit, `factor` (physical value times factor = SI) replaces both; `range` (lowest and highest
    physical value) replaces the DBC's range, [0, 0] means all that the bits can hold.
    """

    signal: Annotated[Name, Meta(description="its name in the DBC")]
    unit: Annotated[Name | None, Meta(description="in place of the DBC's unit")] = None
    factor: Annotated[
        Physical | None, Meta(description="physical value times factor is SI; in place of both units")
    ] = None
    range: Annotated[
        tuple[Physical, Physical] | None,
        Meta(description="lowest and highest physical value in place of the DBC's; 0, 0: all that the bits hold"),
    ] = None


class Protection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """End-to-end protection of a message whose DBC does not declare it."""

    data_id_list: Annotated[
        list[Annotated[int, Meta(ge=0, le=255)]], Meta(max_length=16, description="the Data IDs, one a counter value")
    ]
    profile: Annotated[Literal["P02"], Meta(description="of AUTOSAR end-to-end protection")] = "P02"


class CommandMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message that carries an axis' valve command.

    Without `control` every valid frame counts as Active, and a latched fail-safe lasts to the end of the run.
    `control_values` gives the raw value of each control word (default 0, 1, 2, 3).
    """

    message: Annotated[Name, Meta(description="its name in the DBC")]
    valve_command: Annotated[Name | SignalMapping, Meta(description="the signal with the command, -1 to 1 in SI")]
    control: Annotated[Name | None, Meta(description="the signal with the control word")] = None
    timestamp: Annotated[
        Name | SignalMapping | None, Meta(description="the signal whose value is sent back as `echoed_timestamp`")
    ] = None
    control_values: Annotated[
        dict[Literal["disabled", "hold", "active", "reset"], Raw] | None,
        Meta(description="raw value of each control word; without it 0, 1, 2, 3"),
    ] = None
    protection: Annotated[
        Protection | Literal["dbc", "none"], Meta(description="as the DBC declares it, none, or said here")
    ] = "dbc"
    max_counter_delta: Annotated[
        int, Meta(ge=1, le=14, description="largest step of the counter that is no loss of too many frames")
    ] = MAX_COUNTER_DELTA


class MeasurementMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A message the bench sends: quantity name (encode.QUANTITY_NAMES) -> signal; `cycle_ms` replaces GenMsgCycleTime."""

    message: Annotated[Name, Meta(description="its name in the DBC")]
    signals: Annotated[
        dict[str, Name | SignalMapping],
        Meta(max_length=64, description="measured quantity = signal, the quantities below"),
    ]
    cycle_ms: Annotated[
        Annotated[float, Meta(gt=0, le=_CYCLE_MS_MAX)] | None, Meta(description="in place of GenMsgCycleTime")
    ] = None
    protection: Annotated[
        Protection | Literal["dbc", "none"], Meta(description="as the DBC declares it, none, or said here")
    ] = "dbc"


class AxisMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The messages of one axis."""

    command: Annotated[CommandMapping, Meta(description="the message that carries the valve command")]
    measurements: Annotated[list[MeasurementMapping], Meta(max_length=64, description="the messages the bench sends")]


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
        command=CommandMapping(f"VALVE_COMMAND_{number}", "valve_setpoint", "control", "timestamp_us"),
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
