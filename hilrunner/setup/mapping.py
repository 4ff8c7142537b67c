"""What a profile says of the bus: which message and signal carries which quantity. The structs below are the format.

Identifiers, bits, byte order, scale, unit, range, cycle time, start values and end-to-end protection come from the DBC; a key of
the mapping takes the place of what the DBC says. `default_mapping` is the mapping of firmware_iface/actuator.dbc.
"""

from typing import Literal

import msgspec

MAX_COUNTER_DELTA = 3  # two frames in a row may be lost
HEAVE_MESSAGE = "HEAVE"  # came later than the others: the DBC of an older log has none


class SignalMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One signal.

    `unit` replaces the DBC's unit, `factor` (physical value times factor = SI) replaces both; `range` (lowest and highest
    physical value) replaces the DBC's range, [0, 0] means all that the bits can hold.
    """

    signal: str
    unit: str | None = None
    factor: float | None = None
    range: tuple[float, float] | None = None


class Protection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """End-to-end protection of a message whose DBC does not declare it."""

    data_id_list: list[int]
    profile: Literal["P02"] = "P02"


class CommandMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message that carries an axis' valve command.

    Without `control` every valid frame counts as Active, and a latched fail-safe lasts to the end of the run.
    `control_values` gives the raw value of each control word (default 0, 1, 2, 3).
    """

    message: str
    valve_command: str | SignalMapping
    control: str | None = None
    timestamp: str | SignalMapping | None = None
    control_values: dict[Literal["disabled", "hold", "active", "reset"], int] | None = None
    protection: Protection | Literal["dbc", "none"] = "dbc"
    max_counter_delta: int = MAX_COUNTER_DELTA


class MeasurementMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A message the bench sends: quantity name (encode.QUANTITY_NAMES) -> signal; `cycle_ms` replaces GenMsgCycleTime."""

    message: str
    signals: dict[str, str | SignalMapping]
    cycle_ms: float | None = None
    protection: Protection | Literal["dbc", "none"] = "dbc"


class AxisMapping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The messages of one axis."""

    command: CommandMapping
    measurements: list[MeasurementMapping]


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
