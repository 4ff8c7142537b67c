"""The messages the bench sends, from mapping and database to the tables of realtime.encode."""

from dataclasses import dataclass, field

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.base.units import NS_PER_MS
from hilrunner.realtime import checksum, e2e, encode
from hilrunner.setup import signal_layout, value_tables
from hilrunner.setup.command_table import signal_rows
from hilrunner.setup.database import find_message
from hilrunner.setup.guards import Guard, make_guard
from hilrunner.setup.mapping import MAX_COUNTER_DELTA, AxisMapping, MeasurementMapping, SignalMapping, as_mapping
from hilrunner.setup.pages import Page, fits, page_of, sent_pages
from hilrunner.setup.quantities import QUANTITY_KINDS, curve_of, curve_text, quantity_row
from hilrunner.setup.signal_layout import Placed, Signal
from hilrunner.setup.start_values import put_bits, start_bits, start_image, start_number
from hilrunner.setup.user_check import ReadOwn
from hilrunner.setup.wire_facts import FrameFacts, can_id, frame_facts, has_fast_data, is_fd, signal_facts

LONGEST_CYCLE_MS = 3_600_000


@dataclass
class SentSignal:
    """One mapped signal of a message the bench sends."""

    axis: int
    message: object
    signal: Signal
    quantity: str
    row: np.ndarray
    page: Page
    curve: np.ndarray | None = None  # float64[n, 2]: quantity in SI, physical value

    @property
    def name(self) -> str:
        """`MESSAGE.signal`."""
        return f"{self.message.name}.{self.signal.name}"

    @property
    def told(self) -> str:
        """What the signal carries, for people."""
        text = f"{self.quantity} of axis {self.axis + 1}"
        return text if self.curve is None else f"{text}, {curve_text(self.curve)} (quantity in SI to value sent)"


@dataclass
class _Message:
    """A message with everything that axes map of it."""

    message: object
    entry: MeasurementMapping  # of the first axis that names it
    signals: list[SentSignal] = field(default_factory=list)
    constants: dict[str, float | str] = field(default_factory=dict)


def measurement_table(
    place: str, database, mapping: list[AxisMapping], period_ns: int, read_own: ReadOwn
) -> tuple[encode.MeasurementTable, list[SentSignal], list[FrameFacts]]:
    """The table, the signals in the order of its rows, and what a person wants to know; DbcError as of `signals.wire`."""
    messages = _messages(place, database, mapping)
    builder = _Builder(place, period_ns)
    facts = []
    for stream, one in enumerate(messages):
        guard = make_guard(place, one.message, one.entry.protection, MAX_COUNTER_DELTA, read_own)
        placed = [Placed(sent.signal.name, sent.row, sent.page) for sent in one.signals]
        signal_layout.check_room(f"{place}: {one.message.name}", one.message.length, placed, guard.reserved)
        facts.append(builder.add(stream, one, guard))
    return builder.table(), builder.sent, facts


def _messages(place: str, database, mapping: list[AxisMapping]) -> list[_Message]:
    """The messages in order of first use; what several axes say of one is put together."""
    found: dict[str, _Message] = {}
    for axis, mapped in enumerate(mapping):
        for entry in mapped.measurements:
            message = find_message(place, database, entry.message)
            one = found.setdefault(message.name, _Message(message, entry))
            for key, default in (("protection", "dbc"), ("cycle_ms", None)):
                mine, before = getattr(entry, key), getattr(one.entry, key)
                if mine not in (default, before):
                    raise DbcError(
                        f"{place}: {message.name}",
                        f"is mapped twice with different {key}",
                        remedy="say it once, where it is named first",
                    )
            one.constants |= entry.constants
            for quantity, signals in entry.signals.items():
                for signal in signals if isinstance(signals, list) else [signals]:
                    one.signals.append(_sent_signal(place, axis, message, quantity, as_mapping(signal)))
    return list(found.values())


def _sent_signal(place: str, axis: int, message, quantity: str, mapped: SignalMapping) -> SentSignal:
    if quantity not in encode.QUANTITY_NAMES:
        raise DbcError(f"{place}: {message.name}", f"no quantity '{quantity}'", ", ".join(encode.QUANTITY_NAMES))
    signal = signal_layout.find(place, message, mapped)
    where = f"{place}: {message.name}.{signal.name}"
    if mapped.message not in (None, message.name) or mapped.deadband is not None or mapped.full is not None:
        raise DbcError(where, "`message`, `deadband` and `full` belong to commands", remedy="take them out")
    kind = QUANTITY_KINDS[quantity]
    page = page_of(place, message, signal)
    if mapped.values is not None:
        return _state_signal(where, axis, message, signal, quantity, mapped, page)
    modulus = encode.QUANTITY_NAMES.index(quantity) in encode.WRAPPING_QUANTITIES
    row = quantity_row(where, signal, mapped, kind, modulus)
    curve = None if mapped.curve is None else _inverse(where, curve_of(where, mapped, kind))
    return SentSignal(axis, message, signal, quantity, row, page, curve)


def _state_signal(
    where: str, axis: int, message, signal: Signal, quantity: str, mapped: SignalMapping, page: Page
) -> SentSignal:
    """The bench's state in a table of values of the firmware's own."""
    if quantity != "bench_state":
        raise DbcError(where, f"`values` with {quantity}", "bench_state", "give `unit`, `factor` or `curve`")
    plain = signal_layout.find(where, message, SignalMapping(signal.name, scale=1.0, offset=0.0))
    row = quantity_row(where, plain, SignalMapping(signal.name, factor=1.0), "count")
    states, numbers = value_tables.sent_table(where, signal, mapped, status.MODE_NAMES)
    return SentSignal(axis, message, plain, quantity, row, page, np.column_stack((states, numbers)))


def _inverse(where: str, points: np.ndarray) -> np.ndarray:
    """float64[n, 2], quantity to physical value, of a curve that gives the quantity; DbcError where it has no inverse."""
    turned = points[::-1] if points[0, 1] > points[-1, 1] else points
    steps = np.diff(turned[:, 1])
    if np.any(steps <= 0):
        at = int(np.flatnonzero(steps <= 0)[0])
        raise DbcError(
            where, f"the curve has no inverse: {turned[at, 0]:g} and {turned[at + 1, 0]:g} do not stand for values that rise or fall",
            "a curve that rises or falls all the way", "a sent signal is found from the quantity, so each value may have one point only",
        )  # fmt: skip
    return np.column_stack((turned[:, 1], turned[:, 0]))


class _Builder:
    """The rows of the table as they grow."""

    def __init__(self, place: str, period_ns: int) -> None:
        self.place, self.period_ns = place, period_ns
        self.entries: list[dict] = []
        self.sent: list[SentSignal] = []
        self.sources: list[tuple[int, int, int, int]] = []
        self.curves: list[np.ndarray] = []
        self.guards: list[np.ndarray] = []
        self.guard_signals: list[np.ndarray] = []

    def add(self, stream: int, one: _Message, guard: Guard) -> FrameFacts:
        """One message: an entry for each of its pages."""
        message, where = one.message, f"{self.place}: {one.message.name}"
        cycle = message.cycle_time if one.entry.cycle_ms is None else one.entry.cycle_ms
        if cycle is not None and not 0 <= cycle <= LONGEST_CYCLE_MS:
            raise DbcError(
                where, f"a cycle time of {cycle} ms", f"0 to {LONGEST_CYCLE_MS} ms", "correct GenMsgCycleTime"
            )
        ticks = max(1, round((cycle or 0) * NS_PER_MS / self.period_ns))  # none or 0: every period
        turns = sent_pages(where, [sent.page for sent in one.signals])
        guard_row = self._add_guard(guard)
        for number, turn in enumerate(turns):
            signals = self._on_page(one, turn)
            self.entries.append(
                {
                    "stream": stream,
                    "axes": sum(1 << axis for axis in {sent.axis for sent in one.signals}),
                    "can_id": can_id(message),
                    "length": message.length,
                    "fd": (3 if has_fast_data(message) else 1) if is_fd(message) else 0,
                    "period_ticks": ticks * len(turns),
                    "phase": (stream % ticks) + number * ticks,
                    "protected": guard.kind,
                    "data_ids": guard.data_ids,
                    "guard": guard_row,
                    "checksum_byte": int(guard.row["checksum_byte"]),
                    "counter_start": guard.counter_start,
                    "template": self._template(where, one, turn, guard),
                    "signal_first": len(self.sent),
                    "signal_count": len(signals),
                }
            )
            for sent in signals:
                self._add_signal(sent)
        return self._facts(one, guard, cycle, turns)

    def _on_page(self, one: _Message, turn: dict[str, int]) -> list[SentSignal]:
        """The mapped signals that a frame of this page carries, multiplexers without a turn at their start values."""
        numbers = {signal.name: start_bits(signal) for signal in one.message.signals} | turn
        return [sent for sent in one.signals if fits(sent.page, numbers)]

    def _template(self, where: str, one: _Message, turn: dict[str, int], guard: Guard) -> np.ndarray:
        image = start_image(one.message, turn)
        for name, value in one.constants.items():
            signal = signal_layout.find(self.place, one.message, SignalMapping(name))
            put_bits(image, signal, _constant_bits(f"{where}.{name}", signal, value))
        for byte, mask, value in guard.fixed:
            image[byte] = int(image[byte]) & ~mask & 0xFF | value
        return image

    def _add_signal(self, sent: SentSignal) -> None:
        first = sum(len(curve) for curve in self.curves)
        count = 0 if sent.curve is None else len(sent.curve)
        if sent.curve is not None:
            self.curves.append(sent.curve)
        self.sources.append((sent.axis, encode.QUANTITY_NAMES.index(sent.quantity), first if count else 0, count))
        self.sent.append(sent)

    def _add_guard(self, guard: Guard) -> int:
        if guard.kind != encode.PROTECTED_BY_GUARD:
            return 0
        row = guard.row.copy()
        for name in ("counter_row", "checksum_row"):
            if row[name] != checksum.NO_ROW:
                row[name] += len(self.guard_signals)
        self.guard_signals += guard.signals
        self.guards.append(row)
        return len(self.guards) - 1

    def _facts(self, one: _Message, guard: Guard, cycle: float | None, turns: list[dict[str, int]]) -> FrameFacts:
        told = frame_facts(one.message, cycle, guard.text)
        told.signals = [signal_facts(sent.signal, sent.told, sent.row) for sent in one.signals]
        filled = {sent.signal.name for sent in one.signals} | {name for turn in turns for name in turn}
        for signal in one.message.signals:
            value = one.constants.get(signal.name)
            if signal.name in filled or _is_reserved(signal, guard):
                continue
            physical = value if value is not None else start_number(signal) * signal.scale + signal.offset
            told.constants.append(f"{signal.name} = {physical if isinstance(physical, str) else f'{physical:g}'}")
        if turns != [{}]:
            told.notes.append(f"{len(turns)} pages in turns, each every {(cycle or 0) * len(turns):g} ms")
        return told

    def table(self) -> encode.MeasurementTable:
        """The arrays of all messages."""

        def column(name: str, kind) -> np.ndarray:
            return np.array([entry[name] for entry in self.entries], kind)

        count = len(self.entries)
        points = np.concatenate([*self.curves, np.zeros((0, 2))])
        wide = {
            name: np.int64 for name in ("stream", "axes", "length", "period_ticks", "phase", "guard", "checksum_byte")
        }
        wide |= {name: np.int64 for name in ("signal_first", "signal_count")}
        counter_start = np.zeros(count, np.int64)
        counter_start[[entry["stream"] for entry in self.entries]] = [entry["counter_start"] for entry in self.entries]
        return encode.MeasurementTable(
            message_count=count,
            can_id=column("can_id", np.uint32),
            fd=column("fd", np.uint8),
            protected=column("protected", np.uint8),
            data_ids=column("data_ids", np.uint8).reshape(count, e2e.COUNTER_MODULUS),
            template=column("template", np.uint8).reshape(count, encode.DATA_SIZE_MAX),
            source=np.array(self.sources, encode.SOURCE).reshape(len(self.sources)),
            signals=signal_rows([sent.row for sent in self.sent]),
            curve_x=np.ascontiguousarray(points[:, 0]),
            curve_y=np.ascontiguousarray(points[:, 1]),
            guards=np.array(self.guards, checksum.GUARD).reshape(len(self.guards)),
            guard_signals=signal_rows(self.guard_signals),
            counter_start=counter_start,
            **{name: column(name, kind) for name, kind in wide.items()},
        )


def _constant_bits(where: str, signal: Signal, value: float | str) -> int:
    """The raw bits of a constant, a physical value or a name of the value table; DbcError where they cannot hold it."""
    import struct

    if isinstance(value, str):
        number = value_tables.numbers_of(where, signal, value)[0]
    else:
        number = (value - signal.offset) / signal.scale
    if signal.is_float and not isinstance(value, str):
        return int.from_bytes(struct.pack("<f" if signal.length == 32 else "<d", number), "little")
    low, high = value_tables.raw_span(signal)
    if not low <= round(number) <= high:
        raise DbcError(
            where,
            f"constant {value} does not fit",
            f"{low * signal.scale + signal.offset:g} to {high * signal.scale + signal.offset:g}",
        )
    return round(number) & ((1 << signal.length) - 1)


def _is_reserved(signal, guard: Guard) -> bool:
    """Whether the protection fills this signal."""
    places = signal_layout.bit_places(signal.start, signal.length, signal.byte_order)
    return bool(places) and all(place >= 0 and guard.reserved >> place & 1 for place in places)
