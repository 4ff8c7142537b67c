"""The signals of one axis' command: valve command, magnitude and direction, currents, control word, lines, time stamp."""

import math
from dataclasses import dataclass

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.realtime import bits, decode
from hilrunner.setup import signal_layout, value_tables
from hilrunner.setup.database import find_message
from hilrunner.setup.mapping import CommandMapping, DirectionMapping, LineMapping, SignalMapping, as_mapping
from hilrunner.setup.quantities import CONTROL_NAMES, curve_of, curve_text, quantity_row
from hilrunner.setup.signal_layout import Signal

_DIRECTIONS = {"extend": 1.0, "retract": -1.0, "block": 0.0, "float": 0.0}
_REFUSED = math.nan
_MEANINGS = {
    decode.INPUT_DIRECTION: {1.0: "extend", -1.0: "retract", 0.0: "neutral"},
    decode.INPUT_CONTROL: {float(code): name for code, name in enumerate(CONTROL_NAMES)},
}


@dataclass
class Field:
    """One signal of a command, ready for the tables."""

    message: object
    signal: Signal
    row: np.ndarray
    role: int  # decode.INPUT_*
    use: str  # for people
    numbers: list[float] | None = None  # a table of values
    means: list[float] | None = None
    other: float = _REFUSED  # what other numbers mean
    curve: np.ndarray | None = None

    @property
    def told(self) -> str:
        """What the signal asks for, with its table of values or its curve, for people."""
        if self.curve is not None:
            return f"{self.use}, {curve_text(self.curve)}"
        if self.numbers is None:
            return self.use
        words = _MEANINGS.get(self.role, {0.0: "off", 1.0: "on"})
        told = [
            f"{number:g} {words.get(mean, f'{mean:g}')}" for number, mean in zip(self.numbers, self.means, strict=True)
        ]
        other = "refused" if math.isnan(self.other) else words.get(self.other, f"{self.other:g}")
        return f"{self.use} ({', '.join(told)}; others: {other})"


def axis_fields(place: str, database, command: CommandMapping) -> list[Field]:
    """Every mapped signal of a command; the set point first, then control word, time stamp and lines. DbcError."""
    reader = _Reader(place, database, command)
    return [*reader.setpoint(), *reader.control(), *reader.timestamp(), *reader.lines()]


class _Reader:
    """One command of the mapping beside its database."""

    def __init__(self, place: str, database, command: CommandMapping) -> None:
        self.place, self.database, self.command = place, database, command

    def _found(self, mapped) -> tuple[object, Signal, str]:
        """Message, signal and place of what a key names."""
        message = find_message(self.place, self.database, getattr(mapped, "message", None) or self.command.message)
        plain = mapped if isinstance(mapped, SignalMapping) else SignalMapping(getattr(mapped, "signal", mapped))
        signal = signal_layout.find(self.place, message, plain)
        return message, signal, f"{self.place}: {message.name}.{signal.name}"

    def setpoint(self) -> list[Field]:
        """The signals that say how far the valve opens."""
        command = self.command
        if command.valve_command is not None:
            forms, fields = (
                ["valve_command"],
                [self._opening(command.valve_command, decode.INPUT_SETPOINT, "valve command", -1.0)],
            )
        else:
            forms, fields = [], []
        if command.magnitude is not None or command.direction is not None:
            forms.append("magnitude with direction")
            if command.magnitude is None or command.direction is None:
                lacking = "direction" if command.direction is None else "magnitude"
                raise DbcError(
                    f"{self.place}: {command.message}",
                    f"`{lacking}` is missing",
                    remedy="a magnitude and a direction go together",
                )
            fields += [
                self._opening(command.magnitude, decode.INPUT_SETPOINT, "magnitude"),
                self._direction(command.direction),
            ]
        if command.current_a is not None or command.current_b is not None:
            forms.append("current_a and current_b")
            for mapped, role, use in (
                (command.current_a, decode.INPUT_SETPOINT, "current of edge A"),
                (command.current_b, decode.INPUT_OPPOSED, "current of edge B"),
            ):
                if mapped is not None:
                    fields.append(self._current(mapped, role, use))
        if len(forms) != 1:
            raise DbcError(
                f"{self.place}: {command.message}", f"gives the valve command in {len(forms)} forms ({', '.join(forms) or 'none'})",
                "valve_command; magnitude with direction; current_a and current_b", "keep one of them",
            )  # fmt: skip
        return fields

    def _opening(self, mapped: str | SignalMapping, role: int, use: str, low: float = 0.0) -> Field:
        """A signal that asks for low..1 of the valve, its range cut to that unless a curve holds the ends."""
        mapped = as_mapping(mapped)
        message, signal, where = self._found(mapped)
        mapped = _with_deadband(where, mapped, low)
        row = quantity_row(where, signal, mapped, "ratio")
        if mapped.curve is not None:
            points = curve_of(where, mapped, "ratio")
            if points[:, 1].min() < low or points[:, 1].max() > 1.0:
                raise DbcError(
                    where,
                    f"the curve asks for {points[:, 1].min():g} to {points[:, 1].max():g} of the valve",
                    f"{low:g} to 1",
                )
            return Field(message, signal, row, role, use, curve=points)
        ends = sorted((end - row["offset"]) / row["scale"] for end in (low, 1.0))
        row["number_min"] = max(row["number_min"], ends[0])
        row["number_max"] = min(row["number_max"], ends[1])
        if not row["number_min"] < row["number_max"]:
            raise DbcError(
                f"{self.place}: {message.name}", f"the range of the {use} holds nothing between {low:g} and 1",
                remedy="correct `unit`, `factor` or `range`",
            )  # fmt: skip
        return Field(message, signal, row, role, use)

    def _current(self, mapped: str | SignalMapping, role: int, use: str) -> Field:
        mapped = as_mapping(mapped)
        if mapped.curve is None and mapped.full is None:
            _, _, where = self._found(mapped)
            raise DbcError(
                where, "a current says nothing of the opening by itself", "curve, or full and deadband",
                "give the valve's characteristic: `deadband = 300, full = 700` in the signal's unit, or `curve`",
            )  # fmt: skip
        return self._opening(mapped, role, use)

    def _direction(self, mapped: str | DirectionMapping) -> Field:
        message, signal, where = self._found(mapped)
        given = {name: getattr(mapped, name) for name in _DIRECTIONS} if isinstance(mapped, DirectionMapping) else {}
        given = {name: values for name, values in given.items() if values is not None} or _named_directions(signal)
        if "extend" not in given or "retract" not in given:
            raise DbcError(
                where, f"says which values mean {', '.join(given) or 'nothing'}", "extend and retract at the least",
                'give `direction = { signal = "…", extend = 1, retract = 2, block = 0 }`',
            )  # fmt: skip
        table: dict[float, list] = {}
        for name, values in given.items():
            table.setdefault(_DIRECTIONS[name], []).extend(values if isinstance(values, list) else [values])
        numbers, means = value_tables.meanings(where, signal, table)
        return Field(message, signal, _raw_row(where, signal), decode.INPUT_DIRECTION, "direction", numbers, means)

    def control(self) -> list[Field]:
        """The control word, if there is one."""
        mapped = self.command.control
        if mapped is None:
            if self.command.control_values is not None:
                raise DbcError(
                    f"{self.place}: {self.command.message}",
                    "control_values without `control`",
                    remedy="name the signal",
                )
            return []
        message, signal, where = self._found(mapped)
        if self.command.control_values is None:
            numbers = means = [0.0, 1.0, 2.0, 3.0]
        else:
            table = {float(CONTROL_NAMES.index(name)): values for name, values in self.command.control_values.items()}
            numbers, means = value_tables.meanings(f"{where}: control_values", signal, table)
        return [Field(message, signal, _raw_row(where, signal), decode.INPUT_CONTROL, "control word", numbers, means)]

    def timestamp(self) -> list[Field]:
        """The sender's clock, if it is sent."""
        if self.command.timestamp is None:
            return []
        mapped = as_mapping(self.command.timestamp)
        message, signal, where = self._found(mapped)
        row = quantity_row(where, signal, mapped, "timestamp")
        whole = float(row["scale"]).is_integer() and row["scale"] >= 1 and row["offset"] == 0
        if row["kind"] != bits.KIND_UNSIGNED or not whole or mapped.curve is not None:
            raise DbcError(
                f"{self.place}: {message.name}", "the time stamp must be unsigned and count whole microseconds",
                remedy="leave `timestamp` out of the mapping",
            )  # fmt: skip
        return [Field(message, signal, row, decode.INPUT_TIMESTAMP, "time stamp")]

    def lines(self) -> list[Field]:
        """Enable, dump, safety and reset lines."""
        command = self.command
        named = (
            (command.enable, decode.INPUT_ENABLE, "enable line", {"on": 1}),
            (command.dump, decode.INPUT_DUMP, "dump line", {"off": 0}),
            (command.safety, decode.INPUT_SAFETY, "safety line", {"off": 0}),
            (command.reset, decode.INPUT_RESET, "reset line", {"on": 1}),
        )
        return [self._line(mapped, role, use, default) for mapped, role, use, default in named if mapped is not None]

    def _line(self, mapped: str | LineMapping, role: int, use: str, default: dict[str, int]) -> Field:
        message, signal, where = self._found(mapped)
        on, off = (mapped.on, mapped.off) if isinstance(mapped, LineMapping) else (None, None)
        if on is None and off is None:
            on, off = default.get("on"), default.get("off")
        table = {meaning: values for meaning, values in ((1.0, on), (0.0, off)) if values is not None}
        numbers, means = value_tables.meanings(where, signal, table)
        other = _REFUSED if len(table) == 2 else 0.0 if on is not None else 1.0
        return Field(message, signal, _raw_row(where, signal), role, use, numbers, means, other)


def _raw_row(where: str, signal: Signal) -> np.ndarray:
    """The row of a signal whose numbers are looked up as they are on the wire."""
    return quantity_row(where, signal, SignalMapping(signal.name, factor=1.0), "count")


def _named_directions(signal: Signal) -> dict[str, list[int]]:
    """Directions by the names of the database's value table."""
    words = {
        "extend": ("extend", "out", "lift", "raise"),
        "retract": ("retract", "in", "lower"),
        "block": ("block", "neutral", "hold"),
        "float": ("float",),
    }
    found: dict[str, list[int]] = {}
    for number, name in (signal.choices or {}).items():
        first = str(name).casefold().replace("_", " ").split()
        for key, known in words.items():
            if first and first[0] in known:
                found.setdefault(key, []).append(int(number))
    return found


def _with_deadband(where: str, mapped: SignalMapping, low: float) -> SignalMapping:
    """The mapping with `deadband` and `full` as the curve they stand for."""
    if mapped.deadband is None and mapped.full is None:
        return mapped
    if mapped.curve is not None or mapped.full is None:
        raise DbcError(
            where, "`deadband` goes with `full`, and neither with `curve`", remedy="give `full`, or the curve alone"
        )
    deadband, full = mapped.deadband or 0.0, mapped.full
    if not 0.0 <= deadband < full:
        raise DbcError(where, f"deadband {deadband:g} and full {full:g}", "0 <= deadband < full")
    half = [(deadband, 0.0), (full, 1.0)] if deadband > 0 else [(full, 1.0)]
    points = [(0.0, 0.0), *half]
    if low < 0:
        points = [(-x, -y) for x, y in reversed(half)] + points
    return SignalMapping(
        mapped.signal,
        message=mapped.message,
        unit="",
        scale=mapped.scale,
        offset=mapped.offset,
        range=mapped.range,
        curve=points,
    )
