"""Valve commands from a file in place of the bus: a schedule, or a recorded CAN log read fully before the start.

The log's frames are checked as the loop checks those of a bus, and the commands age as on a bus: a firmware that fell silent in the
recording leaves no valve open here either.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import ProfileError, UsageError
from hilrunner.base.units import NS_PER_MS, NS_PER_S
from hilrunner.plant.schedule import SCHEDULES, Schedule, Table, sample
from hilrunner.realtime import decode
from hilrunner.setup.axes import period_ns, period_s
from hilrunner.setup.can_log import CanLog, kind_of_log, read_can_log
from hilrunner.setup.contract import signal_tables
from hilrunner.setup.profile import CommandRules, LoadedProfile
from hilrunner.setup.profile_files import is_file, sealed_file
from hilrunner.setup.schedule_file import load_schedule, parse_schedule
from hilrunner.setup.stimulus_facts import StimulusFacts
from hilrunner.setup.text import Contents, decoded, read_contents, unpacked

_MOST_TICKS = 100_000_000  # 28 h at 1 kHz; more does not fit in memory
_UNTOUCHED = np.iinfo(np.int64).min
_LONG_AGO_NS = 1 << 60  # 36 years: what lies further back is refused all the same
_BACKWARD_NS = NS_PER_S  # stamps of two channels in one log may be out of order by a little


@dataclass(frozen=True)
class Stimulus:
    """Valve commands for every tick, and how the file they come from was understood."""

    commands: np.ndarray  # float64[tick, axis], -1..1
    facts: StimulusFacts


def profile_schedule(loaded: LoadedProfile) -> str:
    """The profile's own schedule: a name, or a file beside the profile (then its path)."""
    name = loaded.profile.stimulus.schedule
    if name in SCHEDULES or loaded.sealed is not None:
        return name
    beside = loaded.path.parent / name
    return str(beside) if is_file(beside) else name


def profile_stimulus(loaded: LoadedProfile, duration_s: float | None = None, channel: str | None = None) -> Stimulus:
    """The profile's own schedule, as `read_stimulus` has it; for a profile out of a log, out of that log."""
    name, channel = profile_schedule(loaded), channel or loaded.profile.stimulus.channel
    if loaded.sealed is None or name in SCHEDULES:
        return read_stimulus(name, loaded, duration_s, channel)
    contents = unpacked(Path(name), sealed_file(loaded, name).data, UsageError)
    return _from_contents(Path(name), contents, loaded, duration_s, channel)


def load_stimulus(name: str, loaded: LoadedProfile, duration_s: float | None = None) -> np.ndarray:
    """The commands of `read_stimulus` alone."""
    return read_stimulus(name, loaded, duration_s).commands


def read_stimulus(
    name: str, loaded: LoadedProfile, duration_s: float | None = None, channel: str | None = None
) -> Stimulus:
    """Valve commands for every tick from a schedule or a CAN log.

    Args:
        name: a schedule's name or file (every axis gets it), or a CAN log with valve commands of the profile's DBC.
        duration_s: length; a shorter schedule holds its last command, the commands of a shorter log age. None: as long as the file.
        channel: of a CAN log; None: the one that carries the commands.

    Raises:
        UsageError: not found, not readable, too long, without a single valid command, or with commands on several channels.
        ProfileError: a schedule that is none.
    """
    path = Path(name)
    if not name.strip():
        raise UsageError("stimulus", "its name is empty", ", ".join(SCHEDULES), "name a schedule, a CAN log, or none")
    if name in SCHEDULES or not os.path.exists(path):  # false for a name no file can have, where Path.exists raises
        schedule = _named(name)
        return _from_schedule(name, "schedule", schedule, loaded, duration_s)
    contents = read_contents(path, UsageError, "name a schedule or a CAN log")
    return _from_contents(path, contents, loaded, duration_s, channel)


def _from_contents(
    path: Path, contents: Contents, loaded: LoadedProfile, duration_s: float | None, channel: str | None
) -> Stimulus:
    name = str(path)
    kind = kind_of_log(path, contents)
    if kind:
        return _from_can_log(path, read_can_log(path, kind, contents), loaded, duration_s, channel)
    if contents.cut:
        raise UsageError(name, contents.cut, remedy="copy the file again")
    try:
        text = decoded(contents.data)
    except ValueError as error:
        raise ProfileError(
            name, f"cannot be read: {error}", remedy="name a schedule (.csv, .toml) or a CAN log"
        ) from None
    schedule = parse_schedule(text, path)
    return _from_schedule(name, "schedule file", schedule, loaded, duration_s)


def _named(name: str) -> Schedule:
    if name in SCHEDULES or not Path(name).suffix:
        return load_schedule(name)
    raise UsageError(
        name, "no such file", ", ".join(SCHEDULES), "name a CAN log, a schedule file, or one of these schedules"
    )


def _from_schedule(
    name: str, form: str, schedule: Schedule, loaded: LoadedProfile, duration_s: float | None
) -> Stimulus:
    length_s = duration_s if duration_s is not None else schedule.duration_s
    count = _tick_count(name, length_s, loaded)
    commands = sample(schedule, np.arange(count) * period_s(loaded))
    table = isinstance(schedule, Table)
    facts = StimulusFacts(
        name=name,
        form=f"{form}, table of {len(schedule.times_s)} rows" if table else form,
        span_s=float(schedule.duration_s),
        tick_count=count,
        longest_gap_s=float(np.diff(schedule.times_s).max()) if table else math.nan,
    )
    return Stimulus(np.repeat(commands[:, None], len(loaded.profile.axis), axis=1), facts)


def _tick_count(name: str, length_s: float, loaded: LoadedProfile) -> int:
    count = max(1, int(round(length_s / period_s(loaded))))
    if count > _MOST_TICKS:
        raise UsageError(
            name, f"{length_s:g} s are {count} periods", f"at most {_MOST_TICKS} periods", "choose a shorter duration"
        )
    return count


@dataclass
class _Commands:
    """The valid commands of one axis in the order of the log, and which channel each came from."""

    tick: list[int]
    setpoint: list[float]
    control: list[int]
    channel: list[str]


def _from_can_log(
    path: Path, log: CanLog, loaded: LoadedProfile, duration_s: float | None, channel: str | None
) -> Stimulus:
    """The newest valid command of each tick, ageing until the next; every frame is checked as on the bus."""
    if channel is not None:
        log = _one_channel(path, log, channel)
    ticks = _ticks(path, log, loaded)
    by_axis, counts = _decoded(log, ticks, loaded)
    names = [axis.name for axis in loaded.profile.axis]
    _check_valid(path, log, counts, loaded)
    for name, found in zip(names, by_axis, strict=True):
        _check_channels(path, name, found)
    count = int(ticks[-1]) + 1 if duration_s is None else _tick_count(str(path), duration_s, loaded)
    commands, warnings, gap_s = np.empty((count, len(names))), [], 0.0
    for axis, (rules, found) in enumerate(zip(loaded.profile.axis, by_axis, strict=True)):
        aged, longest, told = aged_commands(
            found.tick, found.setpoint, found.control, count, rules.command, period_ns(loaded)
        )
        commands[:, axis] = aged
        gap_s = max(gap_s, longest * period_s(loaded))
        warnings += [f"axis {rules.name}: {told}"] if told else []
    facts = StimulusFacts(
        name=str(path),
        form=log.form,
        span_s=(int(ticks[-1]) + 1) * period_s(loaded) if len(log.time_ns) == 1 else _span_ns(log) / NS_PER_S,
        tick_count=count,
        frame_count=len(log.packet),
        valid_count={name: len(found.tick) for name, found in zip(names, by_axis, strict=True)},
        refused={status.FRAME_STATUS_NAMES[code]: number for code, number in sorted(counts.items()) if code not in
                 (status.FRAME_VALID, status.FRAME_UNKNOWN_ID)},
        channels=tuple(dict.fromkeys(log.channel)),
        used_channels=tuple(dict.fromkeys(one for found in by_axis for one in found.channel)),
        stamps=log.stamps,
        other_lines=log.other_lines,
        longest_gap_s=gap_s,
        warnings=tuple(([f"{log.cut}; what is whole was read"] if log.cut else []) + warnings),
    )  # fmt: skip
    return Stimulus(commands, facts)


def _span_ns(log: CanLog) -> int:
    return max(log.time_ns) - log.time_ns[0]


def _one_channel(path: Path, log: CanLog, channel: str) -> CanLog:
    kept = [index for index, one in enumerate(log.channel) if one == channel]
    if not kept:
        there = ", ".join(dict.fromkeys(one or "(not told)" for one in log.channel))
        raise UsageError(f"--stimulus-channel {channel}", f"{path} has no frame of it", there, "name one of these")
    return CanLog(
        log.form, [log.time_ns[i] for i in kept], [channel] * len(kept), [log.packet[i] for i in kept],
        log.stamps, log.other_lines, log.cut,
    )  # fmt: skip


def _ticks(path: Path, log: CanLog, loaded: LoadedProfile) -> np.ndarray:
    """Tick of every frame from the first one's stamp, int64[frame]; never backwards."""
    first_ns = log.time_ns[0]
    _tick_count(str(path), (max(log.time_ns) - first_ns) / NS_PER_S, loaded)
    times_ns = np.array([max(time_ns - first_ns, -_LONG_AGO_NS) for time_ns in log.time_ns], np.int64)
    newest_ns = np.maximum.accumulate(times_ns)
    back = np.flatnonzero(newest_ns - times_ns > _BACKWARD_NS)
    if len(back):
        raise UsageError(
            str(path),
            f"time goes back by {(newest_ns[back[0]] - times_ns[back[0]]) / NS_PER_S:g} s at frame {back[0] + 1}",
            f"at most {_BACKWARD_NS / NS_PER_S:g} s",
            "split the log where recording began anew",
        )
    return newest_ns // period_ns(loaded)


def _decoded(log: CanLog, ticks: np.ndarray, loaded: LoadedProfile) -> tuple[list[_Commands], dict[int, int]]:
    """Valid commands of every axis, and how many frames had which status.FRAME_*; each channel has counters of its own."""
    axis_count = len(loaded.profile.axis)
    table, _ = signal_tables(loaded)
    found = [_Commands([], [], [], []) for _ in range(axis_count)]
    receivers: dict[str, decode.Receiver] = {}
    counts: dict[int, int] = {}
    data = np.zeros(64, np.uint8)
    for tick, channel, packet in zip(ticks.tolist(), log.channel, log.packet, strict=True):
        data[: len(packet) - 8] = np.frombuffer(packet, np.uint8, offset=8)
        if channel not in receivers:
            receivers[channel] = decode.new_receiver(table, axis_count)
        fresh = receivers[channel].fresh
        fresh["valid_tick"] = _UNTOUCHED
        can_id = int.from_bytes(packet[:4], "little")
        _, code = decode.decode_command(table, can_id, packet[4], data, tick, receivers[channel])
        counts[int(code)] = counts.get(int(code), 0) + 1
        for axis in np.flatnonzero(fresh["valid_tick"] != _UNTOUCHED).tolist():  # one frame may speak to several
            one, new = found[axis], fresh[axis]
            one.tick.append(tick)
            one.setpoint.append(float(new["valve_command"]))
            one.control.append(int(new["control"]))
            one.channel.append(channel)
    return found, counts


def _check_valid(path: Path, log: CanLog, counts: dict[int, int], loaded: LoadedProfile) -> None:
    if counts.get(status.FRAME_VALID):
        return
    reasons = ", ".join(f"{number} {status.FRAME_STATUS_NAMES[code]}" for code, number in sorted(counts.items()))
    raise UsageError(
        str(path),
        f"none of its {len(log.packet)} frames is a valid valve command of {loaded.profile.can.dbc} ({reasons})",
        remedy="record the firmware's command frames, or map the log's DBC in the profile",
    )


def _check_channels(path: Path, axis: str, found: _Commands) -> None:
    """Commands of one axis come from one channel: two in turns are two firmwares, or one that is told twice."""
    channels = list(dict.fromkeys(found.channel))
    if len(channels) > 1:
        counts = ", ".join(f"{found.channel.count(one)} on {one or '(not told)'}" for one in channels)
        raise UsageError(
            str(path),
            f"valid commands of axis {axis} on {len(channels)} channels ({counts})",
            "one channel",
            f"choose one: --stimulus-channel {channels[0]}, or [stimulus] channel in the profile",
        )


def aged_commands(
    ticks: list[int], setpoints: list[float], controls: list[int], count: int, rules: CommandRules, period: int
) -> tuple[np.ndarray, int, str]:
    """What `realtime.command` makes of valid commands: held, then stale: held, ramped to neutral, latched until a Reset.

    Args:
        ticks: of each valid command, never decreasing; setpoints: -1..1; controls: status.CONTROL_*.
        count: ticks wanted. rules: the axis' ageing. period: of the grid, ns.

    Returns:
        float64[count] commands, the longest gap between commands in ticks, and what a user should know (empty: nothing aged).
    """
    commands = np.zeros(count)
    stale_ns = round(rules.stale_after_ms * NS_PER_MS)
    hold_ns, ramp_ns = round(rules.hold_for_ms * NS_PER_MS), round(rules.ramp_for_ms * NS_PER_MS)
    latched_at = first_latch = -1
    longest, stale_count = 0, 0
    for index, tick in enumerate(ticks):
        if tick >= count:
            break
        end = ticks[index + 1] if index + 1 < len(ticks) else count
        if index + 1 < len(ticks):
            longest = max(longest, end - tick)
        if controls[index] == status.CONTROL_RESET:
            latched_at = -1
        end = min(end, count)
        if end == tick or latched_at >= 0:
            continue
        setpoint = setpoints[index] if controls[index] == status.CONTROL_ACTIVE else 0.0
        fresh_end = tick + stale_ns // period + 1  # the first tick that is stale
        commands[tick : min(end, fresh_end)] = setpoint
        if fresh_end >= end:
            continue
        stale_count += 1
        age_ns = (np.arange(fresh_end, end) - tick) * period - stale_ns
        latched = age_ns > hold_ns + ramp_ns
        with np.errstate(divide="ignore", invalid="ignore"):
            ramp = np.where(age_ns <= hold_ns, 1.0, 1.0 - (age_ns - hold_ns) / np.float64(ramp_ns))
        commands[fresh_end:end] = np.where(latched, 0.0, setpoint * np.where(latched, 0.0, ramp))
        if latched.any():
            latched_at = fresh_end + int(np.argmax(latched))
            first_latch = latched_at if first_latch < 0 else first_latch
    return commands, longest, _ageing_text(stale_count, longest, first_latch, latched_at >= 0, rules, period)


def _ageing_text(
    stale_count: int, longest: int, first_latch: int, to_the_end: bool, rules: CommandRules, period: int
) -> str:
    if not stale_count:
        return ""
    text = (
        f"{'once' if stale_count == 1 else f'{stale_count} times'} no command for more than stale_after_ms = {rules.stale_after_ms:g} (longest gap "
        f"{longest * period / NS_PER_S:g} s): the command aged as on a bus"
    )
    if first_latch >= 0:
        until = "and no Reset follows" if to_the_end else "until a Reset"
        text += f", and the fail-safe latched at {first_latch * period / NS_PER_S:g} s, {until}"
    return f"{text}; remedy: where commands are recorded only when they change, raise axis.command.stale_after_ms"
