"""A lift axis and runs of it, for the cross-check's tests."""

import numpy as np

from hilrunner.base import records, status
from hilrunner.plant import load, parameters
from hilrunner.plant.step import SCRATCH_SIZE, AxisPlant, advance_many, assemble, initial_state

PERIOD_S = 1e-3


def lift_axis() -> AxisPlant:
    return AxisPlant(
        circuit=status.CIRCUIT_LIFT,
        parameters=parameters.make_parameters("lift", {}),
        load=load.knuckle_boom(),
        substep_count=16,
    )


def start_state(axis: AxisPlant) -> np.ndarray:
    return initial_state(axis, 0.6)


def run_reference(axis: AxisPlant, commands, scales, state) -> np.ndarray:
    """States (n, 10) at the end of each period."""
    model = assemble([axis], PERIOD_S)
    count = len(commands)
    out = np.zeros((count, 10))
    advance_many(
        model,
        0,
        np.ascontiguousarray(commands, float),
        np.ascontiguousarray(scales, float),
        PERIOD_S,
        state.copy(),
        np.zeros(SCRATCH_SIZE),
        out,
        np.zeros(count, np.int64),
    )
    return out


def as_records(ticks, commands, scales, states):
    """COMMAND and STATE records of one axis."""
    command = records.allocate(records.COMMAND, len(ticks))
    state = records.allocate(records.STATE, len(ticks))
    command["tick"] = state["tick"] = ticks
    command["valve_command"] = commands
    command["mode"] = status.MODE_ACTIVE
    for place, name in enumerate(records.STATE_FIELDS):
        state[name] = states[:, place]
    state["load_scale"] = scales
    return command, state
