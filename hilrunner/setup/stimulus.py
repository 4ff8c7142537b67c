"""Valve commands from a file in place of the bus: a schedule, or a recorded CAN log read fully before the start."""

from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.plant.schedule import load_schedule, sample
from hilrunner.realtime import decode
from hilrunner.setup.axes import period_ns, period_s
from hilrunner.setup.bus import pack_frame
from hilrunner.setup.contract import signal_tables
from hilrunner.setup.profile import LoadedProfile

CAN_LOG_SUFFIXES = (".log", ".asc", ".blf", ".trc", ".mf4")


def load_stimulus(name: str, loaded: LoadedProfile, duration_s: float | None = None) -> np.ndarray:
    """Valve commands for every tick: float64[tick, axis], -1..1.

    Args:
        name: a schedule's name or file (every axis gets it), or a CAN log with valve commands of the profile's DBC.
        duration_s: length; None: as long as the schedule or log.

    Raises:
        UsageError: not found, not readable, or without a single valid command.
    """
    if Path(name).suffix.lower() in CAN_LOG_SUFFIXES:
        return _from_can_log(Path(name), loaded)
    schedule = load_schedule(name)
    length_s = duration_s if duration_s is not None else schedule.duration_s
    count = max(1, int(round(length_s / period_s(loaded))))
    commands = sample(schedule, np.arange(count) * period_s(loaded))
    return np.repeat(commands[:, None], len(loaded.profile.axis), axis=1)


def _from_can_log(path: Path, loaded: LoadedProfile) -> np.ndarray:
    """The newest valid command of each tick, held until the next; every frame is checked as on the bus."""
    frames = _read_frames(path)
    axis_count = len(loaded.profile.axis)
    table, _ = signal_tables(loaded)
    tick_count = int((frames[-1][0] - frames[0][0]) * 1e9 // period_ns(loaded)) + 1
    commands = np.zeros((tick_count, axis_count))
    counter, fresh = decode.no_counters(axis_count), decode.fresh_commands(axis_count)
    valid_count = 0
    for stamp_s, packet in frames:
        data = np.zeros(64, np.uint8)
        data[: len(packet) - 8] = np.frombuffer(packet[8:], np.uint8)
        can_id = int.from_bytes(packet[:4], "little")
        axis, code = decode.decode_command(table, can_id, packet[4], data, counter, fresh)
        if code != status.FRAME_VALID:
            continue
        valid_count += 1
        tick = int((stamp_s - frames[0][0]) * 1e9 // period_ns(loaded))
        active = fresh[axis]["control"] == status.CONTROL_ACTIVE
        commands[tick:, axis] = fresh[axis]["valve_command"] if active else 0.0
    if valid_count == 0:
        raise UsageError(
            f"--stimulus {path}",
            f"none of its {len(frames)} frames is a valid valve command of {loaded.profile.can.dbc}",
            remedy="record VALVE_COMMAND frames, or map the log's DBC in the profile",
        )
    return commands


def _read_frames(path: Path) -> list[tuple[float, bytes]]:
    import can

    try:
        with can.LogReader(path) as reader:
            frames = [(message.timestamp, pack_frame(message)) for message in reader]
    except (OSError, ValueError, TypeError, ImportError, EOFError) as error:
        raise UsageError(
            f"--stimulus {path}", f"cannot be read as a CAN log: {error}", limit=", ".join(CAN_LOG_SUFFIXES)
        ) from error
    if not frames:
        raise UsageError(f"--stimulus {path}", "holds no frames", remedy="name a log with valve commands")
    return frames
