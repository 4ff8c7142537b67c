"""Injected faults: when they begin and end, and what each does."""

import numpy as np
import pytest

from hilrunner.realtime import faults
from hilrunner.realtime.encode import QUANTITY_CHAMBER_1_PRESSURE, QUANTITY_ROD_POSITION, no_quantities


def table(**fields):
    row = np.zeros(1, faults.FAULT)
    row["active_from_tick"] = faults.NEVER
    for name, value in fields.items():
        row[name] = value
    return row


def active_ticks(row, ticks=20, quantities=None):
    seen = []
    quantities = no_quantities(1) if quantities is None else quantities
    for tick in range(ticks):
        faults.trigger.py_func(row, tick, quantities)
        if faults.is_active(row[0], tick):
            seen.append(tick)
    return seen


def test_a_timed_fault_lasts_as_long_as_it_says():
    assert active_ticks(table(start_tick=5, duration_ticks=3)) == [5, 6, 7]
    assert active_ticks(table(start_tick=18)) == [18, 19]


def test_a_condition_starts_a_fault_once():
    quantities = no_quantities(1)
    row = table(
        start_tick=faults.NEVER, condition_quantity=QUANTITY_ROD_POSITION, condition_above=1, condition_threshold=0.5,
        duration_ticks=2,
    )  # fmt: skip
    assert active_ticks(row, 5, quantities) == []
    quantities[0, QUANTITY_ROD_POSITION] = 0.6
    faults.trigger(row, 9, quantities)
    assert faults.is_active(row[0], 9) and faults.is_active(row[0], 10) and not faults.is_active(row[0], 11)
    faults.trigger(row, 15, quantities)
    assert row[0]["active_from_tick"] == 9


def test_what_the_plant_sees():
    stuck = table(kind=faults.VALVE_STUCK, value=0.25, start_tick=0)
    active_ticks(stuck, 1)
    assert faults.valve_command(stuck, 0, 0, -0.9) == 0.25
    assert faults.valve_command(stuck, 1, 0, -0.9) == -0.9, "another axis is not touched"
    gain = table(kind=faults.VALVE_GAIN, value=3.0, start_tick=0)
    active_ticks(gain, 1)
    assert faults.valve_command(gain, 0, 0, 0.2) == pytest.approx(0.6) and faults.valve_command(gain, 0, 0, 0.9) == 1.0
    load = table(kind=faults.LOAD_FACTOR, value=1.5, start_tick=0)
    active_ticks(load, 1)
    assert faults.load_scale(load, 0, 0, 1.1) == pytest.approx(1.65)


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [(faults.SENSOR_OFFSET, 1e5, 6e5), (faults.SENSOR_GAIN, 2.0, 1e6), (faults.SENSOR_STUCK, 0.0, 3e5)],
)
def test_what_the_sensors_show(kind, value, expected):
    quantities = no_quantities(1)
    quantities[0, QUANTITY_CHAMBER_1_PRESSURE] = 3e5
    row = table(kind=kind, value=value, start_tick=0, quantity=QUANTITY_CHAMBER_1_PRESSURE)
    faults.trigger(row, 0, quantities)
    quantities[0, QUANTITY_CHAMBER_1_PRESSURE] = 5e5
    faults.disturb_sensors(row, 0, quantities)
    assert quantities[0, QUANTITY_CHAMBER_1_PRESSURE] == pytest.approx(expected)
