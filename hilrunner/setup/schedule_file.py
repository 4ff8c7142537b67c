"""Valve schedules from files: a table as CSV, or a kind of `plant.schedule` with its fields as TOML; every row is checked."""

import math
import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hilrunner.base.errors import ProfileError
from hilrunner.plant.schedule import SCHEDULES, Chirp, Ramps, RandomSteps, Schedule, Table
from hilrunner.setup import csv_text
from hilrunner.setup.text import read_text

COLUMNS = ["time_s", "valve_command"]
LONGEST_S = 1e7
_MOST_DWELLS = 100_000_000
_SLACK = 1e-9  # of sums of steps such as 0.1 + 0.2 + 0.7
_FRACTION = "a fraction of full opening is meant: write 0.7 for 70 %"
_SECONDS, _FRACTIONS = {"s", "sec", "second", "seconds"}, {"", "-", "1", "p.u."}  # of a row of units below the header


def load_schedule(name_or_path: str) -> Schedule:
    """A schedule by name, or from a .csv or .toml file.

    Raises:
        ProfileError: neither a name nor a readable file, or a file that is not a schedule.
    """
    if name_or_path in SCHEDULES:
        return SCHEDULES[name_or_path]
    path = Path(name_or_path)
    if not os.path.exists(path):
        raise ProfileError(
            f"schedule '{name_or_path}'",
            "neither a known name nor a file",
            ", ".join(SCHEDULES),
            "name one of these, or a file",
        )
    return parse_schedule(read_text(path, ProfileError, "name a schedule or a file"), path)


def parse_schedule(text: str, path: Path) -> Schedule:
    """The schedule in a text; `path` is named in errors, and says whether it is TOML."""
    if path.suffix.lower() == ".toml":
        return _from_toml(text, str(path))
    return _from_csv(text, str(path))


def _from_csv(text: str, place: str) -> Table:
    """Columns time_s, valve_command; a value holds until the next row."""
    try:
        table = csv_text.read_table(text)
    except ValueError as error:
        raise ProfileError(place, f"not a table: {error}", remedy="mend the quotes") from None
    if table.header != COLUMNS:
        found = f"row {table.header_line} is {csv_text.shown(table.header)}" if table.header else "it is empty"
        raise ProfileError(place, f"the first row is not the header of a schedule: {found}", ",".join(COLUMNS),
                           "name the columns so; commas, semicolons or tabs between them")  # fmt: skip
    rows = table.rows
    if rows and _is_units(f"{place}: row {rows[0][0]}", rows[0][1]):
        rows = rows[1:]
    lines = [line for line, _ in rows]
    pairs = [_pair(f"{place}: row {line}", cells) for line, cells in rows]
    times, commands = tuple(time_s for time_s, _ in pairs), tuple(command for _, command in pairs)
    return _checked(
        Table(times[-1] if times else 0.0, times, commands), place, lambda index: f"{place}: row {lines[index]}"
    )


def _is_units(place: str, cells: list[str]) -> bool:
    """Whether the row below the header names units; units that are not the header's own are refused."""
    units = [cell.strip("[]() ").lower() for cell in cells]
    if len(units) != len(COLUMNS) or not units[0].isalpha() or units[0] in ("nan", "inf"):
        return False
    if units[0] not in _SECONDS or units[1] not in _FRACTIONS:
        raise ProfileError(place, f"{csv_text.shown(cells)} are not the units of a schedule", "s, and none", _FRACTION)
    return True


def _pair(place: str, cells: list[str]) -> tuple[float, float]:
    try:
        time_s, command = (csv_text.number(cell) for cell in cells)
    except ValueError:
        raise ProfileError(
            place,
            f"{csv_text.shown(cells)} is not two numbers",
            ",".join(COLUMNS),
            "one number a column; with decimal commas, semicolons between the columns",
        ) from None
    return time_s, command


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
        raise ProfileError(place, f"not TOML: {error}", remedy="mend the syntax at that line") from error
    kind = fields.pop("kind", None)
    if kind not in _KINDS:
        raise ProfileError(f"{place}: kind", f"{kind!r}", ", ".join(_KINDS), "name one of these")
    for key in ("ramps", "times_s", "commands"):
        if isinstance(fields.get(key), list):
            fields[key] = tuple(tuple(item) if isinstance(item, list) else item for item in fields[key])
    try:
        schedule = _KINDS[kind](**fields)
    except TypeError as error:
        names = ", ".join(_KINDS[kind].__dataclass_fields__)
        raise ProfileError(f"{place}: {kind}", str(error).split(") ")[-1], names, "use these fields") from error
    return _checked(schedule, place, lambda index: f"{place}: commands[{index}]")


def _checked(schedule: Schedule, place: str, row_place: Callable[[int], str]) -> Schedule:
    """Refuse what cannot be sampled."""
    if not isinstance(schedule.duration_s, (int, float)) or not 0.0 < schedule.duration_s <= LONGEST_S:
        raise ProfileError(f"{place}: duration_s", f"{schedule.duration_s!r}", f"above 0 to {LONGEST_S:g} s",
                           "name a last time in this range")  # fmt: skip
    try:
        if isinstance(schedule, Table):
            _check_table(schedule, place, row_place)
        if isinstance(schedule, Chirp) and not (schedule.start_hz > 0.0 and schedule.end_hz > 0.0):
            raise ProfileError(f"{place}: start_hz, end_hz", f"{schedule.start_hz}, {schedule.end_hz}", "above 0 Hz")
        if isinstance(schedule, RandomSteps) and not schedule.dwell_s * _MOST_DWELLS >= schedule.duration_s > 0.0:
            raise ProfileError(
                f"{place}: dwell_s", f"{schedule.dwell_s}", f"above {schedule.duration_s / _MOST_DWELLS:g} s"
            )
        values = _extremes(schedule)
    except (TypeError, ValueError) as error:
        raise ProfileError(place, f"a field has the wrong form: {error}", remedy="correct the field") from error
    outside = values[~(np.abs(values) <= 1.0 + _SLACK)]  # NaN as well
    if len(outside):
        raise ProfileError(place, f"commands reach {outside[np.argmax(np.abs(outside))]:g}", "-1 to 1", _FRACTION)
    return schedule


def _extremes(schedule: Schedule) -> np.ndarray:
    """Values that hold the largest and the smallest command of a schedule."""
    if isinstance(schedule, Table):
        return np.asarray(schedule.commands, np.float64)
    if isinstance(schedule, RandomSteps):
        return np.array([schedule.low, schedule.high], np.float64)
    times_s = [np.linspace(0.0, schedule.duration_s, 1001)]
    if isinstance(schedule, Ramps):
        numbers = np.array([schedule.start, *(x for ramp in schedule.ramps for x in ramp)], np.float64)
        if not np.isfinite(numbers).all():
            raise ValueError("a number is not finite")
        for begin, length, _ in schedule.ramps:  # a step or a steep ramp can lie between two of the even times
            times_s += [np.array([np.nextafter(begin, -math.inf), begin]), begin + length * np.linspace(0.0, 1.0, 33)]
    if isinstance(schedule, Chirp):
        cycles = schedule.duration_s * max(schedule.start_hz, schedule.end_hz)
        times_s.append(np.linspace(0.0, schedule.duration_s, int(min(1e6, 40 * cycles + 2))))
    times = np.concatenate(times_s)
    return schedule.values(times[(times >= 0.0) & (times <= schedule.duration_s)])


def _check_table(table: Table, place: str, row_place: Callable[[int], str]) -> None:
    """Every row of a table, not only where it is sampled."""
    if len(table.times_s) < 2 or len(table.times_s) != len(table.commands):
        raise ProfileError(
            place, f"{len(table.times_s)} times, {len(table.commands)} commands", "equally many, 2 or more"
        )
    times_s, commands = np.asarray(table.times_s, np.float64), np.asarray(table.commands, np.float64)
    for index in np.flatnonzero(~np.isfinite(times_s))[:1]:
        raise ProfileError(
            row_place(index), f"time_s is {times_s[index]:g}", "a finite number of seconds", "correct it"
        )
    if times_s[0] < 0.0:
        raise ProfileError(
            row_place(0), f"time_s is {times_s[0]:g}", "0 s or later", "count the times from the start of the run"
        )
    for index in np.flatnonzero(~(np.abs(commands) <= 1.0 + _SLACK))[:1]:
        remedy = "fill the cell, or leave the row out" if math.isnan(commands[index]) else _FRACTION
        raise ProfileError(row_place(index), f"commands reach {commands[index]:g}", "-1 to 1", remedy)
    for index in np.flatnonzero(np.diff(times_s) <= 0.0)[:1] + 1:
        before_s = times_s[index - 1]
        raise ProfileError(row_place(index), f"the times do not increase: {times_s[index]:g} s after {before_s:g} s",
                           "strictly increasing times", "leave one of the rows out")  # fmt: skip
