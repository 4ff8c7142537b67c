"""Valve commands from a file in place of the bus: a schedule, or a recorded CAN log read fully before the start."""

import tempfile
from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.plant.schedule import SCHEDULES, load_schedule, sample
from hilrunner.realtime import decode
from hilrunner.setup.axes import period_ns, period_s
from hilrunner.setup.bus import pack_frame
from hilrunner.setup.contract import signal_tables
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.profile_files import sealed_file

CAN_LOG_SUFFIXES = (".log", ".asc", ".blf", ".trc", ".mf4")
_MOST_TICKS = 100_000_000  # 28 h at 1 kHz; more does not fit in memory
_BACKWARD_S = 1.0  # stamps of two channels in one log may be out of order by a little


def profile_schedule(loaded: LoadedProfile) -> str:
    """The profile's own schedule: a name, or a file beside the profile (then its path)."""
    name = loaded.profile.stimulus.schedule
    if name in SCHEDULES or loaded.sealed is not None:
        return name
    beside = loaded.path.parent / name
    return str(beside) if beside.is_file() else name


def profile_stimulus(loaded: LoadedProfile, duration_s: float | None = None) -> np.ndarray:
    """The valve commands of the profile's own schedule, as `load_stimulus` has them; for a profile out of a log, out of that log."""
    name = profile_schedule(loaded)
    if loaded.sealed is None or name in SCHEDULES:
        return load_stimulus(name, loaded, duration_s)
    found = sealed_file(loaded, name)
    with tempfile.TemporaryDirectory(prefix="hilrunner-schedule-") as folder:
        path = Path(folder) / (Path(name).name or "schedule")
        path.write_bytes(found.data)
        return load_stimulus(str(path), loaded, duration_s)


def load_stimulus(name: str, loaded: LoadedProfile, duration_s: float | None = None) -> np.ndarray:
    """Valve commands for every tick: float64[tick, axis], -1..1.

    Args:
        name: a schedule's name or file (every axis gets it), or a CAN log with valve commands of the profile's DBC.
        duration_s: length, the last command held where the file is shorter; None: as long as the schedule or log.

    Raises:
        UsageError: not found, not readable, too long, or without a single valid command.
    """
    if Path(name).suffix.lower() in CAN_LOG_SUFFIXES:
        return _from_can_log(Path(name), loaded, duration_s)
    schedule = load_schedule(name)
    length_s = duration_s if duration_s is not None else schedule.duration_s
    count = _tick_count(name, length_s, loaded)
    commands = sample(schedule, np.arange(count) * period_s(loaded))
    return np.repeat(commands[:, None], len(loaded.profile.axis), axis=1)


def _tick_count(name: str, length_s: float, loaded: LoadedProfile) -> int:
    count = max(1, int(round(length_s / period_s(loaded))))
    if count > _MOST_TICKS:
        raise UsageError(
            name, f"{length_s:g} s are {count} periods", f"at most {_MOST_TICKS} periods", "choose a shorter duration"
        )
    return count


def _from_can_log(path: Path, loaded: LoadedProfile, duration_s: float | None) -> np.ndarray:
    """The newest valid command of each tick, held until the next; every frame is checked as on the bus."""
    frames = _read_frames(path)
    axis_count = len(loaded.profile.axis)
    table, _ = signal_tables(loaded)
    ticks = _ticks(path, np.array([stamp_s for stamp_s, _ in frames]), loaded)
    count = int(ticks[-1]) + 1 if duration_s is None else _tick_count(str(path), duration_s, loaded)
    commands = np.full((count, axis_count), np.nan)
    counter, fresh = decode.no_counters(axis_count), decode.fresh_commands(axis_count)
    valid_count = 0
    for tick, (_, packet) in zip(ticks, frames, strict=True):
        data = np.zeros(64, np.uint8)
        data[: len(packet) - 8] = np.frombuffer(packet[8:], np.uint8)
        can_id = int.from_bytes(packet[:4], "little")
        axis, code = decode.decode_command(table, can_id, packet[4], data, counter, fresh)
        if code != status.FRAME_VALID:
            continue
        valid_count += 1
        if tick < count:
            active = fresh[axis]["control"] == status.CONTROL_ACTIVE
            commands[tick, axis] = fresh[axis]["valve_command"] if active else 0.0
    if valid_count == 0:
        raise UsageError(
            f"--stimulus {path}",
            f"none of its {len(frames)} frames is a valid valve command of {loaded.profile.can.dbc}",
            remedy="record VALVE_COMMAND frames, or map the log's DBC in the profile",
        )
    return _held(commands)


def _ticks(path: Path, stamps_s: np.ndarray, loaded: LoadedProfile) -> np.ndarray:
    """Tick of every frame from the first one's stamp; never backwards."""
    if not np.isfinite(stamps_s).all():
        raise UsageError(f"--stimulus {path}", "a time stamp is not a finite number", remedy="record it again")
    newest_s = np.maximum.accumulate(stamps_s)
    back = np.flatnonzero(newest_s - stamps_s > _BACKWARD_S)
    if len(back):
        raise UsageError(
            f"--stimulus {path}",
            f"time goes back by {newest_s[back[0]] - stamps_s[back[0]]:g} s at frame {back[0] + 1}",
            f"at most {_BACKWARD_S:g} s",
            "split the log where recording began anew",
        )
    _tick_count(f"--stimulus {path}", float(newest_s[-1] - newest_s[0]), loaded)
    return ((newest_s - newest_s[0]) * 1e9 // period_ns(loaded)).astype(np.int64)


def _held(commands: np.ndarray) -> np.ndarray:
    """Every missing value (NaN) is the last one before it in its column, 0 where there is none."""
    rows = np.where(np.isnan(commands), 0, np.arange(len(commands))[:, None])
    held = np.take_along_axis(commands, np.maximum.accumulate(rows, axis=0), axis=0)
    return np.nan_to_num(held, nan=0.0)


def _read_frames(path: Path) -> list[tuple[float, bytes]]:
    import can

    try:
        with can.LogReader(path) as reader:
            frames = [(message.timestamp, pack_frame(message)) for message in reader]
    except FileNotFoundError as error:
        raise UsageError(f"--stimulus {path}", "no such file", remedy="name a CAN log or a schedule") from error
    except Exception as error:  # every reader of python-can fails in its own way on a damaged or foreign file
        raise UsageError(
            f"--stimulus {path}",
            f"cannot be read as a CAN log: {error or type(error).__name__}",
            limit=", ".join(CAN_LOG_SUFFIXES),
        ) from error
    if not frames:
        raise UsageError(f"--stimulus {path}", "holds no frames", remedy="name a log with valve commands")
    return frames
