"""Injected faults: plant, sensor and bus faults from the profile, triggered by time or by a condition.

A fault is one row of a table; the row also holds when it became active, so that a replay that starts from the same table meets
the same faults at the same ticks.
"""

import numpy as np

from hilrunner.base.compiled import hot

VALVE_STUCK = 0  # the plant sees `value` instead of the command
VALVE_GAIN = 1  # the plant sees command * value, clipped to -1..1
LOAD_FACTOR = 2  # static load * value
SENSOR_OFFSET = 3  # measured quantity + value
SENSOR_GAIN = 4  # measured quantity * value
SENSOR_STUCK = 5  # measured quantity stays at what it was when the fault began
MEASUREMENT_LOST = 6  # the axis sends no frames
MEASUREMENT_BAD_CRC = 7  # the axis' protected frames carry a wrong CRC
COMMAND_LOST = 8  # frames for the axis are not taken
FAULT_NAMES = (
    "valve-stuck",
    "valve-gain",
    "load-factor",
    "sensor-offset",
    "sensor-gain",
    "sensor-stuck",
    "measurement-lost",
    "measurement-bad-crc",
    "command-lost",
)

NEVER = -1

FAULT = np.dtype(
    [
        ("kind", "i8"),
        ("axis", "i8"),
        ("quantity", "i8"),  # sensor faults: index into the quantities of encode
        ("value", "f8"),
        ("start_tick", "i8"),  # time trigger; NEVER for a condition
        ("duration_ticks", "i8"),  # 0: until the end
        ("condition_quantity", "i8"),  # condition trigger on this axis' quantities
        ("condition_above", "i8"),  # 1: quantity > threshold, 0: quantity < threshold
        ("condition_threshold", "f8"),
        ("active_from_tick", "i8"),  # written by `trigger`; NEVER: not yet
        ("held", "f8"),  # sensor-stuck: the value held
    ],
    align=True,
)


@hot
def is_active(row, tick):
    """Whether a fault acts at this tick."""
    begun = row["active_from_tick"]
    if begun < 0 or tick < begun:
        return False
    return row["duration_ticks"] == 0 or tick < begun + row["duration_ticks"]


@hot
def trigger(faults, tick, quantities):
    """Begin the faults whose time or condition has come; quantities are those of the period before."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["active_from_tick"] >= 0:
            continue
        if row["start_tick"] >= 0:
            begins = tick >= row["start_tick"]
        else:
            seen = quantities[row["axis"], row["condition_quantity"]]
            above = seen > row["condition_threshold"]
            below = seen < row["condition_threshold"]
            begins = above if row["condition_above"] == 1 else below
        if begins:
            row["active_from_tick"] = tick
            row["held"] = quantities[row["axis"], row["quantity"]]


@hot
def valve_command(faults, axis, tick, command):
    """The command that reaches the plant."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["axis"] == axis and is_active(row, tick):
            if row["kind"] == VALVE_STUCK:
                command = row["value"]
            elif row["kind"] == VALVE_GAIN:
                command = min(1.0, max(-1.0, command * row["value"]))
    return command


@hot
def load_scale(faults, axis, tick, scale):
    """The load factor that reaches the plant."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["axis"] == axis and row["kind"] == LOAD_FACTOR and is_active(row, tick):
            scale = scale * row["value"]
    return scale


@hot
def disturb_sensors(faults, tick, quantities):
    """Apply sensor faults to what is about to be sent, in place."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if not is_active(row, tick):
            continue
        axis = row["axis"]
        quantity = row["quantity"]
        if row["kind"] == SENSOR_OFFSET:
            quantities[axis, quantity] += row["value"]
        elif row["kind"] == SENSOR_GAIN:
            quantities[axis, quantity] *= row["value"]
        elif row["kind"] == SENSOR_STUCK:
            quantities[axis, quantity] = row["held"]


@hot
def acts(faults, kind, axis, tick):
    """Whether a fault of this kind acts on this axis now."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["kind"] == kind and row["axis"] == axis and is_active(row, tick):
            return True
    return False


@hot
def acts_on_any(faults, kind, axes, tick):
    """Whether a fault of this kind acts now on one of the axes whose bits stand in `axes`."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["kind"] == kind and (axes >> row["axis"]) & 1 and is_active(row, tick):
            return True
    return False


@hot
def any_active(faults, axis, tick):
    """Whether any fault acts on this axis now."""
    for k in range(faults.shape[0]):
        row = faults[k]
        if row["axis"] == axis and is_active(row, tick):
            return True
    return False
