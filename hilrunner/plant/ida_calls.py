"""Compiled code on both sides of IDA: the loop that calls it and the residual it calls. Import after plant.ida has loaded it."""

import numpy as np

from hilrunner.base.compiled import callback, entry
from hilrunner.plant.residual import PLANT_INPUT, make_consistent, residual

import numba  # isort: skip  (after base.compiled)
from numba import types  # isort: skip

_PTR = types.intp
_get_array = types.ExternalFunction("N_VGetArrayPointer", types.voidptr(_PTR))
_get_length = types.ExternalFunction("N_VGetLength", types.int32(_PTR))
_restart = types.ExternalFunction("IDAReInit", types.int32(_PTR, types.float64, _PTR, _PTR))
_stop_at = types.ExternalFunction("IDASetStopTime", types.int32(_PTR, types.float64))
_solve = types.ExternalFunction(
    "IDASolve", types.int32(_PTR, types.float64, types.CPointer(types.float64), _PTR, _PTR, types.int32)
)
_IDA_NORMAL = 1


@callback(types.int32(types.float64, _PTR, _PTR, _PTR, types.voidptr))
def residual_callback(_time, y_vector, dy_vector, r_vector, plant_address):
    """What IDA calls: int (double t, N_Vector y, N_Vector y', N_Vector r, void *plant)."""
    count = _get_length(y_vector)
    y = numba.carray(_get_array(y_vector), (count,), np.float64)
    dy = numba.carray(_get_array(dy_vector), (count,), np.float64)
    r = numba.carray(_get_array(r_vector), (count,), np.float64)
    residual(numba.carray(plant_address, (1,), PLANT_INPUT)[0], y, dy, r)
    return 0


@entry
def drive(
    memory, y_vector, dy_vector, y, dy, plant, places, commands, scales, period_s, first, last, elapsed_s, states_out
):
    """Periods first..last of a run: restart IDA where an input changed, ask it for the end of each period.

    Returns:
        (periods done, time since the last restart); fewer than `last` when IDA failed.
    """
    total = commands.shape[0]
    reached_s = np.zeros(1)
    for i in range(first, last):
        if i == 0 or commands[i] != commands[i - 1] or scales[i] != scales[i - 1]:
            plant[0]["valve_command"] = min(max(commands[i], -1.0), 1.0)
            plant[0]["load_scale"] = scales[i]
            make_consistent(plant[0], y, dy)
            elapsed_s = 0.0
            same = i + 1
            while same < total and commands[same] == commands[i] and scales[same] == scales[i]:
                same += 1
            if _restart(memory, 0.0, y_vector, dy_vector) < 0 or _stop_at(memory, (same - i) * period_s) < 0:
                return i, elapsed_s
        elapsed_s += period_s
        if _solve(memory, elapsed_s, reached_s.ctypes, y_vector, dy_vector, _IDA_NORMAL) < 0:
            return i, elapsed_s
        for k in range(places.shape[0]):
            states_out[i, places[k]] = y[k]
        if places.shape[0] == 7:
            states_out[i, 8] = plant[0]["parameters"]["supply_pressure_pa"]
    return last, elapsed_s
