"""`replay --out`: the run with its reference beside it, as a log for Foxglove and PlotJuggler."""

from pathlib import Path

import numpy as np

from hilrunner.base import records
from hilrunner.base.state_layout import STATE_SIZE
from hilrunner.evidence.reader import Run
from hilrunner.evidence.replay import Replay
from hilrunner.evidence.replay_dae import AxisDae
from hilrunner.record.levels import LOG_LEVEL_INFO
from hilrunner.record.mcap_log import LogWriter

_BLOCK = 1000  # ticks between flushes: about a second, so that every topic of a second lies together


def write_replay(path: str | Path, replay: Replay) -> None:
    """Write ticks, commands, states, misses and frames of the run, `/<axis>/check` anew, and IDA's states as `/<axis>/dae`.

    The attachments go along, so that the new log can be replayed too. Raises LogError when it cannot be written.
    """
    run = replay.run
    start_mono_ns, start_real_ns = clock_of(run, replay.facts.period_ns)
    attachments = [(name, one.media_type, one.data) for name, one in run.attachments.items()]
    data_size = (run.can_rx if len(run.can_rx) else run.can_tx)["data"].shape[1]
    writer = LogWriter(path, run.axis_names, data_size, run.metadata, attachments)
    for axis in replay.axes:
        writer.add_topic(f"/{axis.axis}/dae", "State", records.STATE)
    frames = np.concatenate((run.can_rx, run.can_tx)) if data_size else run.can_rx
    frames = frames[np.argsort(frames["mono_ns"], kind="stable")]
    truth = {axis.axis: _dae_records(axis) for axis in replay.axes}
    for start in range(0, len(run.tick), _BLOCK):
        tick = run.tick[start : start + _BLOCK]
        _write_block(writer, replay, tick, truth, start_mono_ns, start_real_ns)
        low, high = tick["tick"][0], tick["tick"][-1]
        writer.write_can(frames[(frames["tick"] >= low) & (frames["tick"] <= high)], start_mono_ns, start_real_ns)
        misses = run.miss[(run.miss["tick"] >= low) & (run.miss["tick"] <= high)]
        writer.write_miss(misses, start_real_ns, replay.facts.period_ns)
        writer.flush()
    writer.write_log(LOG_LEVEL_INFO, "replay", f"reference beside {replay.path.name}", start_real_ns)
    writer.close()


def clock_of(run: Run, period_ns: int) -> tuple[int, int]:
    """(start on CLOCK_MONOTONIC, start on CLOCK_REALTIME) of a run's tick 0, ns."""
    table = run.metadata.get("run", {})
    first = run.tick[0]
    offset_ns = int(first["tick"]) * period_ns
    mono, real = int(first["deadline_mono_ns"]) - offset_ns, run.start_publish_ns - offset_ns
    try:
        return int(table.get("start_mono_ns", mono)), int(table.get("start_real_ns", real))
    except ValueError:
        return mono, real


def _write_block(
    writer: LogWriter, replay: Replay, tick: np.ndarray, truth, start_mono_ns: int, start_real_ns: int
) -> None:
    run = replay.run
    rows = {axis: (_at(run.command[axis], tick["tick"]), _at(run.state[axis], tick["tick"])) for axis in run.axis_names}
    whole = [axis for axis, (command, state) in rows.items() if len(command) == len(state) == len(tick)]
    if len(whole) == len(run.axis_names):
        command = np.stack([rows[axis][0] for axis in whole], axis=1).reshape(-1)
        state = np.stack([rows[axis][1] for axis in whole], axis=1).reshape(-1)
        writer.write_ticks(tick, command, state, start_mono_ns, start_real_ns)
    offset_ns = start_real_ns - start_mono_ns
    for axis in replay.axes:
        check, dae = _at(axis.check, tick["tick"]), _at(truth[axis.axis], tick["tick"])
        own = _at(tick, check["tick"])
        log_ns, publish_ns = own["end_mono_ns"] + offset_ns, own["deadline_mono_ns"] + offset_ns
        writer.write_check(axis.axis, check, log_ns, publish_ns)
        writer.write_records(f"/{axis.axis}/dae", dae, log_ns, publish_ns)


def _at(rows: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Rows of the given ticks; both in order of tick."""
    place = np.searchsorted(rows["tick"], ticks)
    inside = place < len(rows)
    place = place[inside]
    return rows[place[rows["tick"][place] == ticks[inside]]]


def _dae_records(axis: AxisDae) -> np.ndarray:
    rows = records.allocate(records.STATE, len(axis.tick))
    rows["tick"] = axis.tick
    for place in range(STATE_SIZE):
        rows[records.STATE_FIELDS[place]] = axis.ida[:, place]
    rows["load_force_n"] = np.nan  # not a state: IDA does not give it
    rows["load_scale"] = np.nan
    return rows
