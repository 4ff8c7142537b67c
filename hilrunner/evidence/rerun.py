"""The commands of a log, period by period, so that another run can be given the same."""

import numpy as np

from hilrunner.base import records
from hilrunner.base.errors import LogError, UsageError
from hilrunner.evidence.facts import read_facts
from hilrunner.evidence.reader import Run
from hilrunner.evidence.rebuild import engine_of, sealed_profile, socket_frames, stimulus_of
from hilrunner.evidence.replay_exact import known_misses
from hilrunner.realtime import faults as fault_kinds
from hilrunner.realtime.cycle import run_offline
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.axes import period_ns
from hilrunner.setup.blocks import blocks
from hilrunner.setup.profile import LoadedProfile

_BLOCK_TICKS = 2000


def commands_again(run: Run, loaded: LoadedProfile, duration_s: float | None = None) -> np.ndarray:
    """What the valves of a run were told in each of its periods, for another run of `loaded`.

    A run that was given a stimulus gives it again. A run that was driven by frames gives what its frames came to: checked, aged,
    held and ramped as the bench did, before valve faults, so that the faults of a profile act once.

    Args:
        run: read with all columns. loaded: the profile that is to be run; its period may differ, each of its ticks takes the
            command that held at its time. duration_s: length, the last command held; None: as long as the log.

    Returns:
        float64[tick, axis], -1..1.

    Raises:
        LogError: the log holds no commands. UsageError: it has other axes than the profile.
    """
    names = [axis.name for axis in loaded.profile.axis]
    if set(run.axis_names) != set(names):
        raise UsageError(
            f"--stimulus {run.path}", f"has the axes {', '.join(run.axis_names)}", ", ".join(names),
            "name the same log as the profile",
        )  # fmt: skip
    own = stimulus_of(run, [])
    if own is None:
        own = _from_frames(run)
    own = own[:, [run.axis_names.index(name) for name in names]]
    log_period_ns, period = read_facts(run).period_ns, period_ns(loaded)
    length = len(own) * log_period_ns if duration_s is None else round(duration_s * 1e9)
    count = max(1, -(-length // period))
    at = np.arange(count, dtype=np.int64) * period // log_period_ns
    return np.ascontiguousarray(own[np.minimum(at, len(own) - 1)])


def _from_frames(run: Run) -> np.ndarray:
    """Every grid period a tick of its own, with the frames of its tick; the stages are those of the bench."""
    if not len(run.tick) or not len(run.can_rx):
        raise LogError(str(run.path), "holds no commands", remedy="name the log of a run that received some")
    loaded = sealed_profile(run)
    armed = arm_offline(loaded, engine_of(run))
    _without_valve_faults(armed.bench.faults)
    frames, sizes, of_tick = socket_frames(run)
    count = int(run.tick["tick"][-1]) + 1
    if count > 1 << 31:
        raise LogError(str(run.path), f"tick number {count - 1} is damaged")
    first = np.searchsorted(of_tick, np.arange(count + 1)).astype(np.int64)
    _, forced = known_misses(run, read_facts(run), np.arange(count))
    commands = np.zeros((count, len(run.axis_names)))
    order = [[axis.name for axis in loaded.profile.axis].index(name) for name in run.axis_names]
    for begin, end in blocks(count, _BLOCK_TICKS):
        command = records.allocate(records.COMMAND, (end - begin) * len(order)).reshape(end - begin, len(order))
        state = records.allocate(records.STATE, (end - begin) * len(order)).reshape(end - begin, len(order))
        ticks, ones = np.arange(begin, end), np.ones(end - begin, np.int64)
        done = run_offline(
            armed.bench, ticks, ones, ones * 0, forced[begin:end], frames, sizes, first[begin : end + 1], command, state
        )
        commands[begin:end] = command["valve_command"][:, order]
        if done < end - begin:
            return commands[: begin + done]
    return commands


def _without_valve_faults(faults: np.ndarray) -> None:
    valve = np.isin(faults["kind"], (fault_kinds.VALVE_STUCK, fault_kinds.VALVE_GAIN))
    faults["kind"][valve] = fault_kinds.VALVE_GAIN
    faults["value"][valve] = 1.0
