"""Valve commands over time as data: ramps, tables, chirps and pseudo-random steps, by name or from a file."""

import csv
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base.errors import ProfileError


@dataclass(frozen=True)
class Ramps:
    """A sum of smooth changes: from `start`, each (begin_s, length_s, change); length 0 is a step."""

    duration_s: float
    ramps: tuple[tuple[float, float, float], ...]
    start: float = 0.0

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t; s."""
        total = np.full_like(t, self.start)
        for begin, length, change in self.ramps:
            if length <= 0.0:
                total += change * (t >= begin)
            else:
                s = np.clip((t - begin) / length, 0.0, 1.0)
                total += change * s**3 * (10.0 + s * (-15.0 + 6.0 * s))
        return total


@dataclass(frozen=True)
class Table:
    """Values at times, held until the next time or joined by straight lines."""

    duration_s: float
    times_s: tuple[float, ...]
    commands: tuple[float, ...]
    linear: bool = False

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t; before the first time the first value, after the last the last."""
        if self.linear:
            return np.interp(t, self.times_s, self.commands)
        index = np.searchsorted(self.times_s, t, side="right") - 1
        return np.asarray(self.commands)[np.maximum(index, 0)]


@dataclass(frozen=True)
class Chirp:
    """offset + amplitude sin(phase), frequency rising exponentially from start to end over the duration."""

    duration_s: float
    start_hz: float
    end_hz: float
    amplitude: float
    offset: float = 0.0

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t."""
        rate = math.log(self.end_hz / self.start_hz) / self.duration_s
        if rate == 0.0:
            return self.offset + self.amplitude * np.sin(2.0 * math.pi * self.start_hz * t)
        return self.offset + self.amplitude * np.sin(2.0 * math.pi * self.start_hz / rate * np.expm1(rate * t))


@dataclass(frozen=True)
class RandomSteps:
    """Pseudo-random binary sequence: low or high, drawn anew every dwell time."""

    duration_s: float
    dwell_s: float
    low: float
    high: float
    seed: int = 1

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t."""
        count = math.ceil(self.duration_s / self.dwell_s) + 1
        bits = np.random.default_rng(self.seed).integers(0, 2, count)
        index = np.clip((t / self.dwell_s).astype(np.int64), 0, count - 1)
        return np.where(bits[index] == 1, self.high, self.low).astype(np.float64)


Schedule = Ramps | Table | Chirp | RandomSteps

# the article's Figure 6 as far as its text tells it: commands 0, .5, 1, .3, .8, 0, .6, 0 (docs/paper.md)
_LIFT = (
    (0.5, 0.30, 0.5),
    (4.0, 0.20, 0.5),
    (8.0, 0.20, -0.7),
    (11.0, 1.0, 0.5),
    (14.5, 0.10, -0.8),
    (16.5, 0.05, 0.6),
    (19.0, 0.30, -0.6),
)
_LIFT_2MS = tuple((begin, length if length == 1.0 else 0.002, change) for begin, length, change in _LIFT)

SCHEDULES: dict[str, Schedule] = {
    "lift-profile": Ramps(20.0, _LIFT),
    "lift-profile-2ms": Ramps(20.0, _LIFT_2MS),
    "lift-hold-lower-hold": Ramps(
        60.0,
        (
            (1.0, 0.3, 0.6),
            (10.0, 0.2, 0.4),
            (18.0, 0.3, -1.0),
            (30.0, 0.3, -0.5),
            (40.0, 0.3, -0.5),
            (50.0, 0.5, 1.0),
        ),
    ),
    "overrun": Ramps(20.0, ((0.5, 0.3, 0.3), (6.0, 0.2, 0.3), (12.0, 0.1, 0.4), (16.0, 0.3, -1.0))),
    "steps": Ramps(12.0, ((1.0, 0.0, 0.5), (3.0, 0.0, 0.5), (5.0, 0.0, -1.0), (7.0, 0.0, -0.5), (10.0, 0.0, 0.5))),
    "chirp": Chirp(20.0, 0.1, 10.0, 0.4),
    "prbs": RandomSteps(20.0, 0.25, -0.5, 0.6),
    "hold": Ramps(60.0, ()),
    "full-lift": Ramps(30.0, ((0.5, 0.3, 1.0),)),
    "full-lower": Ramps(30.0, ((0.5, 0.3, -1.0),)),
}


def sample(schedule: Schedule, times_s: np.ndarray) -> np.ndarray:
    """(n,) float64 commands at (n,) times, clipped to -1..1."""
    return np.clip(schedule.values(np.asarray(times_s, dtype=np.float64)), -1.0, 1.0)


def load_schedule(name_or_path: str) -> Schedule:
    """A schedule by name, or from a .csv or .toml file.

    Raises:
        ProfileError: neither a name nor a readable file, or a file that is not a schedule.
    """
    if name_or_path in SCHEDULES:
        return SCHEDULES[name_or_path]
    path = Path(name_or_path)
    if not path.is_file():
        raise ProfileError(
            f"schedule '{name_or_path}'", "neither a known name nor a file", ", ".join(SCHEDULES), "name one of these"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ProfileError(str(path), f"cannot be read: {error}") from error
    if path.suffix == ".toml":
        return _from_toml(text, str(path))
    return _from_csv(text, str(path))


def _from_csv(text: str, place: str) -> Table:
    """Columns time_s, valve_command; a value holds until the next row."""
    rows = [row for row in csv.reader(text.splitlines()) if row and not row[0].lstrip().startswith("#")]
    if not rows or [name.strip() for name in rows[0]] != ["time_s", "valve_command"]:
        raise ProfileError(place, "the first row is not a header", "time_s,valve_command")
    times, commands = [], []
    for number, row in enumerate(rows[1:], start=2):
        try:
            time_s, command = (float(cell) for cell in row)
        except ValueError as error:
            raise ProfileError(
                f"{place}: row {number}", f"{','.join(row)!r} is not two numbers", "time_s,valve_command"
            ) from error
        times.append(time_s)
        commands.append(command)
    return _checked(Table(times[-1] if times else 0.0, tuple(times), tuple(commands)), place)


_KINDS: dict[str, Callable[..., Schedule]] = {
    "ramps": Ramps,
    "table": Table,
    "chirp": Chirp,
    "random-steps": RandomSteps,
}


def _from_toml(text: str, place: str) -> Schedule:
    """A table `kind = ...` with that kind's fields."""
    try:
        fields = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(place, f"not TOML: {error}") from error
    kind = fields.pop("kind", None)
    if kind not in _KINDS:
        raise ProfileError(f"{place}: kind", f"{kind!r}", ", ".join(_KINDS))
    for key in ("ramps", "times_s", "commands"):
        if isinstance(fields.get(key), list):
            fields[key] = tuple(tuple(item) if isinstance(item, list) else item for item in fields[key])
    try:
        schedule = _KINDS[kind](**fields)
    except TypeError as error:
        names = ", ".join(_KINDS[kind].__dataclass_fields__)
        raise ProfileError(f"{place}: {kind}", str(error).split(") ")[-1], names) from error
    return _checked(schedule, place)


def _checked(schedule: Schedule, place: str) -> Schedule:
    """Refuse what cannot be sampled."""
    if not isinstance(schedule.duration_s, (int, float)) or not 0.0 < schedule.duration_s <= 1e7:
        raise ProfileError(f"{place}: duration_s", f"{schedule.duration_s!r}", "above 0 to 1e7 s")
    try:
        if isinstance(schedule, Table):
            _check_table(schedule, place)
        if isinstance(schedule, Chirp) and not (schedule.start_hz > 0.0 and schedule.end_hz > 0.0):
            raise ProfileError(f"{place}: start_hz, end_hz", f"{schedule.start_hz}, {schedule.end_hz}", "above 0 Hz")
        if isinstance(schedule, RandomSteps) and not schedule.dwell_s > 0.0:
            raise ProfileError(f"{place}: dwell_s", f"{schedule.dwell_s}", "above 0 s")
        values = schedule.values(np.linspace(0.0, schedule.duration_s, 1001))
    except (TypeError, ValueError) as error:
        raise ProfileError(place, f"a field has the wrong form: {error}") from error
    if not np.isfinite(values).all() or np.abs(values).max() > 1.0 + 1e-9:
        raise ProfileError(place, f"commands reach {np.abs(values).max():g}", "-1 to 1")
    return schedule


def _check_table(table: Table, place: str) -> None:
    if len(table.times_s) < 2 or len(table.times_s) != len(table.commands):
        raise ProfileError(
            place, f"{len(table.times_s)} times, {len(table.commands)} commands", "equally many, 2 or more"
        )
    if np.any(np.diff(table.times_s) <= 0.0):
        raise ProfileError(place, "the times do not increase", "strictly increasing times")
