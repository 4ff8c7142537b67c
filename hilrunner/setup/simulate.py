"""A schedule through `realtime.cycle.run_offline`: what `hilrunner simulate` and the figures of other commands rest on."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilrunner.base import records
from hilrunner.realtime.cycle import run_offline
from hilrunner.realtime.socketcan import FRAME_SIZE_FD
from hilrunner.setup.arm import Armed, arm_offline
from hilrunner.setup.axes import period_ns
from hilrunner.setup.blocks import blocks
from hilrunner.setup.profile import LoadedProfile

_CHUNK_TICKS_MAX = 1000


@dataclass(frozen=True)
class Simulated:
    """One simulated run; record arrays as in a log."""

    armed: Armed
    engine: int
    tick: np.ndarray  # (n,) records.TICK, times on the grid, durations 0
    command: np.ndarray  # (n, axis) records.COMMAND
    state: np.ndarray  # (n, axis) records.STATE


def simulate(
    loaded: LoadedProfile,
    engine: int,
    stimulus: np.ndarray,
    progress: Callable[[float], None] | None = None,
) -> Simulated:
    """Run valve commands, float64[tick, axis] of -1..1, on the axes of a profile; deterministic.

    Args:
        engine: status.ENGINE_*. progress: told the share done, 0..1.
    """
    armed = arm_offline(loaded, engine, stimulus)
    count, axis_count = stimulus.shape
    tick = records.allocate(records.TICK, count)
    tick["tick"] = np.arange(count)
    for name in ("deadline_mono_ns", "wake_mono_ns", "end_mono_ns"):
        tick[name] = np.arange(count) * period_ns(loaded)
    command = records.allocate(records.COMMAND, count * axis_count).reshape(count, axis_count)
    state = records.allocate(records.STATE, count * axis_count).reshape(count, axis_count)
    frames, sizes = np.zeros((0, FRAME_SIZE_FD), np.uint8), np.zeros(0, np.int64)
    done = 0
    for begin, end in blocks(count, _CHUNK_TICKS_MAX):
        n = end - begin
        zeros, ones = np.zeros(n, np.int64), np.ones(n, np.int64)
        ran = run_offline(
            armed.bench, np.arange(begin, end), ones, zeros, zeros, frames, sizes, np.zeros(n + 1, np.int64),
            command[begin:end], state[begin:end],
        )  # fmt: skip
        done += ran
        if ran < n:
            break
        if progress:
            progress(done / count)
    return Simulated(armed, engine, tick[:done], command[:done], state[:done])
