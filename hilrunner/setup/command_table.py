"""The messages that carry commands, from mapping and database to the tables of realtime.decode."""

from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.base.units import NS_PER_MS
from hilrunner.realtime import bits, checksum, decode
from hilrunner.setup import signal_layout
from hilrunner.setup.command_fields import Field, axis_fields
from hilrunner.setup.guards import Guard, make_guard
from hilrunner.setup.mapping import MAX_COUNTER_DELTA, CommandMapping, Protection
from hilrunner.setup.pages import Page, multiplexer_row, page_of
from hilrunner.setup.signal_layout import Placed
from hilrunner.setup.user_check import ReadOwn
from hilrunner.setup.wire_facts import FrameFacts, can_id, frame_facts, signal_facts

_ALL_BITS = 0xFFFFFFFF
P02_DELTA_MAX = 14  # of a counter of 16; other counters have theirs in their guard


@dataclass
class _Group:
    """One axis' part of a message, of one page."""

    axis: int
    page: Page
    fields: list[Field] = field(default_factory=list)


@dataclass
class _Frame:
    """One message: its parts by axis and page, and how it is judged."""

    message: object
    protection: Protection | str
    max_counter_delta: int
    groups: list[_Group] = field(default_factory=list)

    def add(self, axis: int, page: Page, one: Field) -> None:
        """Put a field into the part it belongs to."""
        for group in self.groups:
            if group.axis == axis and group.page == page:
                group.fields.append(one)
                return
        self.groups.append(_Group(axis, page, [one]))


class _Rows:
    """The flat arrays as they grow."""

    def __init__(self) -> None:
        self.signals: list[np.ndarray] = []
        self.condition_signals: list[np.ndarray] = []
        self.conditions: list[tuple[int, int, int]] = []
        self.fields: list[np.ndarray] = []
        self.numbers: list[float] = []
        self.means: list[float] = []
        self.curves: list[np.ndarray] = []
        self.guards: list[np.ndarray] = []
        self.guard_signals: list[np.ndarray] = []

    def values(self, numbers: list[float], means: list[float]) -> int:
        """Append a table of values; its first row."""
        first = len(self.numbers)
        self.numbers += numbers
        self.means += means
        return first

    def curve(self, points: np.ndarray) -> int:
        """Append the points of a curve; its first row."""
        first = sum(len(one) for one in self.curves)
        self.curves.append(points)
        return first


def command_messages(command: CommandMapping) -> list[str]:
    """The names of the messages a command comes in, its own first."""
    others = [
        mapped.message
        for mapped in (
            command.valve_command, command.magnitude, command.direction, command.current_a, command.current_b,
            command.control, command.timestamp, command.enable, command.dump, command.safety, command.reset,
        )
        if mapped is not None and not isinstance(mapped, str) and mapped.message is not None
    ]  # fmt: skip
    return list(dict.fromkeys([command.message, *others]))


def command_table(
    place: str, database, commands: list[CommandMapping], read_own: ReadOwn, period_ns: int, stale_after_ms: list[float]
) -> tuple[decode.CommandTable, list[FrameFacts]]:
    """The table of all axes' commands, and what a person wants to know of their messages; DbcError as of `signals.wire`."""
    frames = _frames(place, database, commands)
    rows = _Rows()
    built = np.zeros(len(frames), decode.FRAME)
    groups: list[np.ndarray] = []
    facts: list[FrameFacts] = []
    group_count = [
        sum(group.axis == axis for frame in frames.values() for group in frame.groups) for axis in range(len(commands))
    ]
    for index, (name, frame) in enumerate(frames.items()):
        guard = make_guard(place, frame.message, frame.protection, frame.max_counter_delta, read_own)
        _check_frame(place, frame, guard)
        row = built[index]
        row["can_id"], row["id_mask"], row["length"] = can_id(frame.message), _ALL_BITS, frame.message.length
        row["group_first"], row["group_count"] = len(groups), len(frame.groups)
        row["max_counter_delta"], row["protected"] = min(frame.max_counter_delta, P02_DELTA_MAX), guard.kind
        row["data_ids"], row["guard"] = guard.data_ids, _add_guard(rows, guard)
        told = frame_facts(frame.message, frame.message.cycle_time, guard.text)
        for group in frame.groups:
            grace_ticks = _grace_ticks(commands[group.axis], name, stale_after_ms[group.axis], period_ns)
            groups.append(_group_row(rows, place, frame.message, group, group_count[group.axis] > 1, grace_ticks))
            told.signals += [
                signal_facts(one.signal, f"{one.told} of axis {group.axis + 1}", one.row) for one in group.fields
            ]
        facts.append(told)
    return _packed(built, groups, rows), facts


def _frames(place: str, database, commands: list[CommandMapping]) -> dict[str, _Frame]:
    """The messages in order of first use, each with its parts sorted by axis."""
    frames: dict[str, _Frame] = {}
    for axis, command in enumerate(commands):
        for one in axis_fields(place, database, command):
            message = one.message
            frame = frames.setdefault(message.name, _Frame(message, "dbc", MAX_COUNTER_DELTA))
            frame.add(axis, page_of(place, message, one.signal), one)
        _settle_protection(place, frames, command)
    for frame in frames.values():
        frame.groups.sort(key=lambda group: group.axis)  # stable: pages of an axis stay in order
    return frames


def _settle_protection(place: str, frames: dict[str, _Frame], command: CommandMapping) -> None:
    """What the mapping says of each message; two axes that say different things of one message contradict each other."""
    said = [(command.message, command.protection, command.max_counter_delta)]
    said += [(one.message, one.protection, one.max_counter_delta) for one in command.frames]
    for name, protection, max_counter_delta in said:
        if name not in frames:
            raise DbcError(
                f"{place}: {name}",
                "no signal of this message is mapped",
                ", ".join(frames),
                "map one, or take it out of `frames`",
            )
        frame = frames[name]
        for key, value, default in (
            ("protection", protection, "dbc"),
            ("max_counter_delta", max_counter_delta, MAX_COUNTER_DELTA),
        ):
            before = getattr(frame, key)
            if value != default and before not in (default, value):
                raise DbcError(f"{place}: {name}", f"two axes give it different {key}", remedy="say it once, or alike")
            if value != default:
                setattr(frame, key, value)
    if not all(1 <= frame.max_counter_delta for frame in frames.values()):
        raise DbcError(
            f"{place}: {command.message}", f"max_counter_delta {command.max_counter_delta} does not fit", "1..14"
        )


def _check_frame(place: str, frame: _Frame, guard: Guard) -> None:
    placed = [Placed(one.signal.name, one.row, group.page) for group in frame.groups for one in group.fields]
    where = f"{place}: {frame.message.name}"
    signal_layout.check_room(where, frame.message.length, placed, guard.reserved, may_repeat=True)


def _add_guard(rows: _Rows, guard: Guard) -> int:
    if guard.kind != decode.PROTECTED_BY_GUARD:
        return 0
    row = guard.row.copy()
    for name in ("counter_row", "checksum_row"):
        if row[name] != checksum.NO_ROW:
            row[name] += len(rows.guard_signals)
    rows.guard_signals += guard.signals
    rows.guards.append(row)
    return len(rows.guards) - 1


def _grace_ticks(command: CommandMapping, message: str, stale_after_ms: float, period_ns: int) -> int:
    """How much older than the axis' command this message may be, in periods."""
    for one in command.frames:
        if one.message == message and one.stale_after_ms is not None:
            return round((one.stale_after_ms - stale_after_ms) * NS_PER_MS / period_ns)
    return 0


def _group_row(rows: _Rows, place: str, message, group: _Group, shared: bool, grace_ticks: int) -> np.ndarray:
    row = np.zeros((), decode.GROUP)
    row["axis"], row["shared"], row["grace_ticks"] = group.axis, shared, grace_ticks
    row["field_first"], row["field_count"] = len(rows.fields), len(group.fields)
    row["condition_first"], row["condition_count"] = len(rows.conditions), len(group.page)
    for name, numbers in group.page.items():
        first = rows.values([float(number) for number in sorted(numbers)], [0.0] * len(numbers))
        rows.conditions.append((len(rows.condition_signals), first, len(numbers)))
        rows.condition_signals.append(multiplexer_row(place, message, name))
    for one in group.fields:
        rows.fields.append(_field_row(rows, one))
        rows.signals.append(one.row)
    return row


def _field_row(rows: _Rows, one: Field) -> np.ndarray:
    row = np.zeros((), decode.FIELD)
    row["role"], row["other"] = one.role, one.other
    if one.numbers is not None:
        row["is_listed"] = 1
        row["value_first"], row["value_count"] = rows.values(one.numbers, one.means), len(one.numbers)
    if one.curve is not None:
        row["curve_first"], row["curve_count"] = rows.curve(one.curve), len(one.curve)
    return row


def _packed(frames: np.ndarray, groups: list[np.ndarray], rows: _Rows) -> decode.CommandTable:
    conditions = np.zeros(len(rows.conditions), decode.CONDITION)
    for index, (signal, first, count) in enumerate(rows.conditions):
        conditions[index] = (len(rows.signals) + signal, first, count)
    points = np.concatenate([*rows.curves, np.zeros((0, 2))])
    return decode.CommandTable(
        frames=frames,
        groups=np.array(groups, decode.GROUP).reshape(len(groups)),
        fields=np.array(rows.fields, decode.FIELD).reshape(len(rows.fields)),
        conditions=conditions,
        signals=signal_rows(rows.signals + rows.condition_signals),
        value_number=np.array(rows.numbers, np.float64),
        value_meaning=np.array(rows.means, np.float64),
        curve_x=np.ascontiguousarray(points[:, 0]),
        curve_y=np.ascontiguousarray(points[:, 1]),
        guards=np.array(rows.guards, checksum.GUARD).reshape(len(rows.guards)),
        guard_signals=signal_rows(rows.guard_signals),
    )


def signal_rows(rows: list[np.ndarray]) -> np.ndarray:
    """bits.SIGNAL rows as one array."""
    return np.array(rows, bits.SIGNAL).reshape(len(rows))
