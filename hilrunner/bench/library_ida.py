"""A rival: IDA as its Python package offers it (scikit-sundae), the residual compiled, the solver started anew each period.

What a simulation in a control loop does with a standard tool: an input changes every millisecond, the solver's history is
gone, it is initialised again and asked for the end of the period. Kind to the rival: the consistent start is computed by
our own compiled code, not by IDA's search.
"""

import numpy as np

from hilrunner.base.compiled import entry
from hilrunner.plant.model import AxisPlant
from hilrunner.plant.residual import ALGEBRAIC_COUNT, PLANT_INPUT, UNKNOWNS, make_consistent, residual

_SCALE = np.array([1e-1, 1e-2, 1e5, 1e5, 1e-3, 1e-3, 1e-2, 1e-2, 1e5, 1e5])  # atol over rtol, by place of the state
_MAX_STEPS = 100_000


@entry
def _residual(plant, y, dy, r):
    residual(plant[0], y, dy, r)


@entry
def _consistent(plant, y, dy):
    return make_consistent(plant[0], y, dy)


def library_ida_states(plant: AxisPlant, commands: np.ndarray, period_s: float, start: np.ndarray, rtol: float):
    """A first-principle plant over held commands, load factor 1: float64[n, 10].

    Raises:
        ArithmeticError: IDA gave up.
    """
    from sksundae.ida import IDA

    places = np.array(UNKNOWNS[plant.circuit])
    count = len(places)
    data = np.zeros(1, PLANT_INPUT)
    data["circuit"], data["load_scale"] = plant.circuit, 1.0
    data["parameters"], data["load"] = plant.parameters[0], plant.load.record()[0]
    algebraic = list(range(count - ALGEBRAIC_COUNT[plant.circuit], count))
    solver = IDA(
        lambda t, y, dy, r: _residual(data, y, dy, r),
        rtol=rtol,
        atol=rtol * _SCALE[places],
        algebraic_idx=algebraic or None,
        max_num_steps=_MAX_STEPS,
    )
    y, dy = start[places].copy(), np.zeros(count)
    states = np.zeros((len(commands), 10))
    for i, command in enumerate(commands):
        data["valve_command"] = command
        _consistent(data, y, dy)
        solver.init_step(0.0, y, dy)
        found = solver.step(period_s, tstop=period_s)
        if not found.success:
            raise ArithmeticError(f"IDA gave up in period {i}: {found.message}")
        y[:], dy[:] = found.y, found.yp
        states[i, places] = y
    return states
