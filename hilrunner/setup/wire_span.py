"""Can every mapped signal carry what its quantity will be? Start state and plausible span against the signal's range.

What does not fit is sent as the nearest value that does, so a range that an editor left at [0|1] would hide the whole plant from
the firmware. Warnings, no refusals: a transmitter that ends short of the plant is common, and logs of such benches must stay
replayable.
"""

import math

import numpy as np

from hilrunner.base import state_layout, status
from hilrunner.plant.load import LoadTable
from hilrunner.plant.step import AxisPlant
from hilrunner.plant.wave import COMPONENT_AMPLITUDE, COMPONENT_ANGULAR_FREQUENCY
from hilrunner.setup.axes import AxisSet
from hilrunner.setup.contract import axis_mappings, dbc_path, wiring
from hilrunner.setup.fault_values import old_keys
from hilrunner.setup.load_span import load_warnings
from hilrunner.setup.measurement_table import SentSignal
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.start_values import start_value_notes
from hilrunner.setup.wire_text import wiring_notes

_ROUNDING = 0.5  # of a raw step: what rounding alone puts beyond an end
_STANDARD_DEVIATIONS = 4.0  # of a Gaussian sea, beyond which it goes once in four hours


def bench_warnings(loaded: LoadedProfile, axes: AxisSet) -> list[str]:
    """What a bench accepts and a person should know: loads that end short, signals that cannot carry their quantity, odd mappings."""
    found = load_warnings(loaded, axes.plants) + wire_warnings(loaded, axes) + _unknown_references(loaded)
    return found + wiring_notes(loaded, wiring(loaded)) + old_keys(loaded.profile.fault, str(loaded.path))


def _unknown_references(loaded: LoadedProfile) -> list[str]:
    """Tracking limits against a heave that no message tells the firmware."""
    tracked = [key for key in loaded.profile.limits if key.startswith("tracking")]
    found = []
    for index, (axis, mapped) in enumerate(zip(loaded.profile.axis, axis_mappings(loaded), strict=True)):
        told = {quantity for entry in mapped.measurements for quantity in entry.signals}
        if tracked and axis.wave is not None and "heave_position" not in told:
            found.append(
                f"{loaded.path}: limits.{tracked[0]}: the rod of axis '{axis.name}' is to follow the heave of its wave, which no "
                f"mapped message tells the firmware; remedy: map `heave_position` in can.mapping[{index}].measurements, or judge "
                "against a motion of your own with `hilrunner report --reference`"
            )
    return found


def wire_warnings(loaded: LoadedProfile, axes: AxisSet) -> list[str]:
    """One sentence for every mapped measurement whose signal cannot carry its start or its span, and for odd start values."""
    place = dbc_path(loaded).name
    starts = [_start_values(axes, axis) for axis in range(len(axes.plants))]
    spans = [_plausible_spans(plant, wave) for plant, wave in zip(axes.plants, axes.waves, strict=True)]
    found: list[str] = []
    messages = {}
    for sent in wiring(loaded).sent:
        messages[sent.message.name] = sent.message
        wire = _Wire(f"{place}: {sent.name}", sent)
        told = wire.judged(starts[sent.axis].get(sent.quantity), spans[sent.axis].get(sent.quantity))
        found += [text for text in told if text not in found]
    for message in messages.values():
        found += [f"{place}: {note}" for note in start_value_notes(message)]
    return found


class _Wire:
    """One mapped signal: its row, and the physical values of its ends."""

    def __init__(self, place: str, sent: SentSignal) -> None:
        self.place, self.sent, self.signal, self.row = place, sent, sent.signal, sent.row

    def number(self, value_si: float) -> float:
        """What a value is on the wire, before rounding and clamping; a curve goes on beyond its ends as a straight line."""
        if self.sent.curve is not None:
            value_si = _continued(self.sent.curve, value_si)
        return (value_si - float(self.row["offset"])) / float(self.row["scale"])

    def text(self, number: float) -> str:
        """A number on the wire as a physical value with the unit."""
        physical = number * float(self.signal.scale) + float(self.signal.offset)
        return f"{physical:.6g} {self.signal.unit or ''}".rstrip()

    def beyond(self, value_si: float) -> float | None:
        """The end of the range that would be sent instead of this value; None where it fits."""
        curve = self.sent.curve
        if curve is not None and not curve[0, 0] <= value_si <= curve[-1, 0]:
            end = curve[0, 1] if value_si < curve[0, 0] else curve[-1, 1]
            return (float(end) - float(self.row["offset"])) / float(self.row["scale"])
        number = self.number(value_si)
        low, high = float(self.row["number_min"]), float(self.row["number_max"])
        slack = _ROUNDING if not self.signal.is_float else 0.0
        return low if number < low - slack else high if number > high + slack else None

    def judged(self, start_si: float | None, span_si: tuple[float, float] | None) -> list[str]:
        """At most one sentence: the start is the graver of the two."""
        if float(self.row["modulus"]) > 0:
            return []  # it wraps, so every value fits
        spoken = self.sent.quantity.replace("_", " ")
        remedy = "remedy: correct the range in the database, or give the mapping `range = [lowest, highest]`"
        ends = f"{self.text(float(self.row['number_min']))} to {self.text(float(self.row['number_max']))}"
        if start_si is not None and (sent := self.beyond(start_si)) is not None:
            return [
                f"{self.place}: the {spoken} starts at {self.text(self.number(start_si))}, outside the signal's range, {ends}; "
                f"it is sent as {self.text(sent)}; {remedy}"
            ]
        for value in span_si or ():
            if (sent := self.beyond(value)) is not None:
                return [
                    f"{self.place}: the {spoken} may reach {self.text(self.number(value))}, outside the signal's range, {ends}; "
                    f"it would be sent as {self.text(sent)}; {remedy}"
                ]
        return []


def _continued(curve: np.ndarray, value: float) -> float:
    """A curve's value, with its first and last piece going on beyond the ends."""
    if curve[0, 0] <= value <= curve[-1, 0]:
        return float(np.interp(value, curve[:, 0], curve[:, 1]))
    (x0, y0), (x1, y1) = curve[:2] if value < curve[0, 0] else curve[-2:]
    return float(y0 + (y1 - y0) * (value - x0) / (x1 - x0))


def _start_values(axes: AxisSet, axis: int) -> dict[str, float]:
    """SI values of the quantities in the first frames."""
    state, parameters = axes.initial_states[axis], axes.plants[axis].parameters
    return {
        "chamber_1_pressure": float(state[state_layout.CHAMBER_1_PRESSURE]),
        "chamber_2_pressure": float(state[state_layout.CHAMBER_2_PRESSURE]),
        "supply_pressure": float(parameters["supply_pressure_pa"][0]),
        "line_a_pressure": float(state[state_layout.LINE_A_PRESSURE]),
        "line_b_pressure": float(state[state_layout.LINE_B_PRESSURE]),
        "rod_position": float(state[state_layout.ROD_POSITION]),
        "rod_velocity": float(state[state_layout.ROD_VELOCITY]),
        "spool_1_position": float(state[state_layout.SPOOL_1_POSITION]),
        "spool_2_position": float(state[state_layout.SPOOL_2_POSITION]),
        "valve_command": 0.0,
        "bench_state": float(status.MODE_WAITING),
        "flags": 0.0,
        "heave_position": 0.0,
        "heave_velocity": 0.0,
    }


def _plausible_spans(plant: AxisPlant, wave: np.ndarray) -> dict[str, tuple[float, float]]:
    """SI values between which a quantity moves in ordinary work; what has no such bound is left out."""
    constants = {name: float(plant.parameters[name][0]) for name in plant.parameters.dtype.names}
    supply = constants["supply_pressure_pa"]
    reach = plant.position_range_m or (0.0, constants["stroke_m"])
    drop = math.sqrt(supply)
    extend = constants["valve_pa_si"] * drop / constants["bore_area_m2"]
    retract = constants["valve_pb_si"] * drop / constants["rod_side_area_m2"]
    heave_m = _STANDARD_DEVIATIONS * math.sqrt(float(np.sum(wave[:, COMPONENT_AMPLITUDE] ** 2)) / 2)
    speed = wave[:, COMPONENT_AMPLITUDE] * wave[:, COMPONENT_ANGULAR_FREQUENCY]
    heave_mps = _STANDARD_DEVIATIONS * math.sqrt(float(np.sum(speed**2)) / 2)
    return {
        **dict.fromkeys(
            ("chamber_1_pressure", "chamber_2_pressure", "line_a_pressure", "line_b_pressure"), (0.0, supply)
        ),
        "rod_position": reach,
        "rod_velocity": (-retract, extend),
        "spool_1_position": (0.0, constants["spool_stroke_m"]),
        "spool_2_position": (0.0, constants["spool_stroke_m"]),
        "load_force": _load_span_n(plant.load, *reach),
        "valve_command": (-1.0, 1.0),
        "bench_state": (0.0, float(len(status.MODE_NAMES) - 1)),
        "flags": (0.0, float(status.BUS_FLAGS)),
        "heave_position": (-heave_m, heave_m),
        "heave_velocity": (-heave_mps, heave_mps),
    }


def _load_span_n(load: LoadTable, low_m: float, high_m: float) -> tuple[float, float]:
    """Smallest and largest static force over a stretch of the rod's way."""
    inside = load.knots_m[(load.knots_m > low_m) & (load.knots_m < high_m)]
    forces = np.interp(np.concatenate(([low_m], inside, [high_m])), load.knots_m, load.force_n)
    return float(forces.min()), float(forces.max())
