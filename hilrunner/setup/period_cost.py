"""What one period of a bench costs on this machine, measured: a plant that takes longer than its period can never keep it."""

import time

import numpy as np

from hilrunner.base import records
from hilrunner.base.errors import ProfileError
from hilrunner.realtime.cycle import run_offline
from hilrunner.realtime.socketcan import FRAME_SIZE_FD
from hilrunner.setup.arm import Armed
from hilrunner.setup.axes import period_s

_TICKS_MIN, _TICKS_MAX = 5, 200
_ENOUGH_S = 0.2


def period_cost_s(armed: Armed) -> float:
    """Shortest time of one period, s: the shortest of up to 200, so that other work on the machine is not blamed. The bench moves on."""
    shortest = np.inf
    axes = len(armed.axes.plants)
    command = records.allocate(records.COMMAND, axes).reshape(1, axes)
    state = records.allocate(records.STATE, axes).reshape(1, axes)
    frames, sizes, none = np.zeros((0, FRAME_SIZE_FD), np.uint8), np.zeros(0, np.int64), np.zeros(2, np.int64)
    one, zero = np.ones(1, np.int64), np.zeros(1, np.int64)
    begun_s = time.perf_counter()
    for tick in range(_TICKS_MAX):
        begin_s = time.perf_counter()
        run_offline(armed.bench, np.array([tick]), one, zero, zero, frames, sizes, none, command, state)
        end_s = time.perf_counter()
        shortest = min(shortest, end_s - begin_s)
        if tick >= _TICKS_MIN and end_s - begun_s > _ENOUGH_S:
            break
    return float(shortest)


def check_period_cost(armed: Armed) -> float:
    """`period_cost_s`; ProfileError where one period takes longer than the period."""
    cost_s, period = period_cost_s(armed), period_s(armed.loaded)
    if cost_s <= period:
        return cost_s
    plants = zip(armed.loaded.profile.axis, armed.axes.plants, strict=True)
    raise ProfileError(
        f"{armed.loaded.path}: bench.period_us",
        f"one period takes at least {cost_s * 1e6:.0f} us here ("
        + ", ".join(f"{axis.name}: {plant.substep_count} substeps" for axis, plant in plants)
        + ")",
        f"below {period * 1e6:g} us",
        "a longer period, fewer axes, or parameters that are less stiff; `hilrunner simulate` needs no clock",
    )
