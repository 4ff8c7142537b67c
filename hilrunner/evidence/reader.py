"""A run read from its log: whole topics as arrays of our records, whatever state the log is in.

    run = read_run("runs/x.mcap")
    run.tick["wake_mono_ns"] - run.tick["deadline_mono_ns"]
    run.state["lift"]["rod_position_m"]

`columns` bounds memory: a report over an hour at 1 kHz asks for the columns it needs and nothing else is kept.
"""

import fnmatch
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base import records
from hilrunner.base.errors import LogError
from hilrunner.evidence import mcap_walk, schema
from hilrunner.evidence.budget import AXES_MAX, OWN_CHANNELS_MAX, Budget
from hilrunner.evidence.damaged import DamagedLogError, hash_mismatches
from hilrunner.evidence.mcap_scan import Contents, Scanner

_SPARE_ROWS = 1024
_SPARE_RATIO = 1.05
_LARGEST_GROWTH = 4096.0
_EVENTS_MAX, _EVENT_CHARACTERS_MAX = 10_000, 2000
_CHANNELS = 1 << 16  # a channel's number has two bytes
_UNKNOWN, _FOREIGN, _OWN, _EVENTS = 0, 1, 2, 3
_FEW_CHANNELS = 64
_CAN_DATA_BYTES_MAX = 64

Columns = dict[str, tuple[str, ...] | None]  # topic pattern -> fields to keep, None: all
Consumer = Callable[[str, np.ndarray], None]  # (topic, rows); the rows are valid during the call only


@dataclass(frozen=True)
class Attachment:
    """A file inside the log."""

    media_type: str
    data: bytes

    @property
    def text(self) -> str:
        """The content as UTF-8 text; damaged characters are replaced."""
        return self.data.decode("utf-8", "replace")


@dataclass(frozen=True)
class Event:
    """A sentence of the topic /log."""

    real_ns: int
    level: int  # 10 debug, 20 info, 30 warning, 40 error, 50 fatal
    name: str
    text: str


@dataclass(frozen=True)
class Run:
    """What a log holds. Arrays have the layouts of base.records (or the columns asked for), in log order."""

    path: Path
    size_bytes: int
    topics: dict[str, np.ndarray]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, Attachment]
    damage: tuple[str, ...]  # sentences; empty: the log is whole
    mismatches: tuple[
        str, ...
    ]  # of these, the parts that do not match their checksums or hashes: not cut off, but changed
    finished: bool
    library: str
    start_publish_ns: int  # publish time of the first tick, Unix epoch; 0: no tick
    first_log_ns: int
    schemas: dict[str, str]  # topic -> text of its schema
    missing_fields: dict[str, tuple[str, ...]]  # topic -> fields that its records lack, read as 0
    events: tuple[Event, ...] = ()
    foreign_topics: tuple[str, ...] = ()

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Axes in the order of the profile if the log says it, else in order of appearance."""
        found = [match[1] for topic in self.topics if (match := re.fullmatch(r"/([^/]+)/(?:state|command)", topic))]
        named = self.metadata.get("run", {}).get("axis_names", "")
        order = [name.strip() for name in named.split(",") if name.strip()]
        return tuple(dict.fromkeys([name for name in order if name in found] + found))

    def topic(self, name: str, layout: np.dtype) -> np.ndarray:
        """A topic's records, or none of `layout`."""
        return self.topics.get(name, np.zeros(0, layout))

    @property
    def tick(self) -> np.ndarray:
        return self.topic("/rt/tick", records.TICK)

    @property
    def miss(self) -> np.ndarray:
        return self.topic("/rt/miss", records.MISS)

    @property
    def statistics(self) -> np.ndarray:
        return self.topic("/rt/statistics", records.STATISTICS)

    @property
    def can_rx(self) -> np.ndarray:
        return self.topic("/can/rx", records.CAN_FRAME)

    @property
    def can_tx(self) -> np.ndarray:
        return self.topic("/can/tx", records.CAN_FRAME)

    @property
    def command(self) -> dict[str, np.ndarray]:
        return {axis: self.topic(f"/{axis}/command", records.COMMAND) for axis in self.axis_names}

    @property
    def state(self) -> dict[str, np.ndarray]:
        return {axis: self.topic(f"/{axis}/state", records.STATE) for axis in self.axis_names}

    @property
    def check(self) -> dict[str, np.ndarray]:
        return {axis: self.topic(f"/{axis}/check", records.CHECK) for axis in self.axis_names}


def read_run(
    path: str | Path,
    columns: Columns | None = None,
    consumers: dict[str, Consumer] | None = None,
    begin: Callable[[dict[str, dict[str, str]], dict[str, tuple[str, bytes]]], None] | None = None,
) -> Run:
    """Read a log.

    Args:
        path: an MCAP file written by hilrunner, in any state.
        columns: topic pattern (`/rt/tick`, `/*/state`) -> the fields to keep (None: all of them); topics that match no
            pattern are left out. Without it everything is kept.
        consumers: topic pattern -> who gets its rows batch by batch instead of their being kept.
        begin: called with the metadata and attachments (name -> media type, data) of the log's head before the first batch.

    Every checksum of the file is compared; what does not match is told in `mismatches`. Raises LogError when the file is
    missing, empty, no MCAP file, or holds no topic of ours; DamagedLogError when that is because it is damaged.
    """
    collector = _Collector(columns, consumers or {}, begin)
    scanner = Scanner(path, collector.take)
    collector.contents = scanner.contents
    collector.scanner = scanner
    contents = scanner.run()
    collector.note_damage()
    for text in hash_mismatches(contents.metadata, {name: data for name, (_, data) in contents.attachments.items()}):
        contents.harm(text)
    if not collector.own_topics and contents.mismatches:
        raise DamagedLogError(str(path), f"damaged, and nothing in it can be read: {contents.mismatches[0]}")
    if not collector.own_topics:
        names = {channel[0] for channel in contents.channels.values()}
        if "/rt/tick" in names:  # ours, and cut off (or ended) before its first chunk
            why = contents.damage[0] if contents.damage_count else "the run ended before its first tick"
            raise LogError(str(path), f"holds no tick: {why}", "a log with a tick", "nothing of this run can be saved")
        topics = ", ".join(sorted(names)[:8])
        found = f"its topics are {topics}" if topics else "it holds no topics"
        if contents.damage_count:
            found += f"; {contents.damage[0]}"
        raise LogError(
            str(path), f"not a log of this program: {found}", "/rt/tick, /<axis>/state, …", "name a run's log"
        )
    hidden = contents.damage_count - len(contents.damage)
    damage = [*contents.damage, *([f"{hidden} more places like these"] if hidden else [])]
    return Run(
        path=Path(path),
        size_bytes=Path(path).stat().st_size,
        topics={buffer.topic: buffer.array() for buffer in collector.buffers_in_order()},
        metadata=contents.metadata,
        attachments={name: Attachment(*pair) for name, pair in contents.attachments.items()},
        damage=tuple(damage),
        mismatches=tuple(contents.mismatches),
        finished=contents.finished,
        library=contents.library,
        start_publish_ns=collector.start_publish_ns,
        first_log_ns=collector.first_log_ns,
        schemas=_schema_texts(contents),
        missing_fields=collector.missing_fields(),
        events=tuple(collector.events),
        foreign_topics=tuple(sorted(collector.foreign)),
    )


class _Topic:
    """One channel of ours: its records go into an array, or to a consumer batch by batch.

    The array is made as large as the rest of the file suggests: unused rows cost nothing.
    """

    def __init__(self, topic: str, wire: np.dtype, keep: np.dtype, consumer: Consumer | None) -> None:
        self.topic = topic
        self.missing = schema.missing(wire, keep)
        self.count = 0
        self.other_size = 0
        self._size = wire.itemsize - records.MESSAGE_OFFSET
        self._spans = schema.copy_spans(wire, keep)
        self._consumer = consumer
        self._array = np.zeros(0, keep)

    def take(
        self, buffer: np.ndarray, messages: np.ndarray, channel: int, count: int, read_ratio: float, budget: Budget
    ) -> None:
        """Take the `count` messages of `channel`; `read_ratio` of the file (0..1) has been read."""
        rows = self._room(count, read_ratio, budget)
        for name in self.missing if "unused" not in rows.dtype.names else ("unused", *self.missing):
            rows[name] = 0
        target = rows.view("u1").reshape(count, rows.dtype.itemsize)
        taken, other = mcap_walk.gather(buffer, messages, channel, self._size, self._spans, target)
        self.count += taken
        self.other_size += other
        if self._consumer:
            self._consumer(self.topic, rows[:taken])

    def array(self) -> np.ndarray:
        """The records taken, in order of tick; none of a topic with a consumer."""
        rows = self._array[: 0 if self._consumer else self.count]
        if "tick" in (rows.dtype.names or ()) and np.any(rows["tick"][1:] < rows["tick"][:-1]):
            return rows[np.argsort(rows["tick"], kind="stable")]  # written in order of time by another tool
        return rows

    def _room(self, count: int, read_ratio: float, budget: Budget) -> np.ndarray:
        """Rows for `count` messages: a consumer's are its own only during its call."""
        if self._consumer:
            return np.empty(count, self._array.dtype)
        budget.keep(count * self._array.dtype.itemsize)
        kept, least = self.count, self.count + count
        if least > len(self._array):
            expected = least * min(_SPARE_RATIO / max(read_ratio, 1e-9), _LARGEST_GROWTH) + _SPARE_ROWS
            most = least + budget.keepable_bytes // self._array.dtype.itemsize
            grown = np.empty(int(min(expected, most)), self._array.dtype)
            grown[:kept] = self._array[:kept]
            self._array = grown
        return self._array[kept:least]


class _Collector:
    """Sorts batches of messages into topic buffers."""

    def __init__(self, columns: Columns | None, consumers: dict[str, Consumer], begin=None) -> None:
        self._begin = begin
        self.contents = Contents()
        self.scanner: Scanner | None = None
        self._columns = columns
        self._consumers = consumers
        self._buffers: dict[int, _Topic] = {}
        self._kind = np.full(_CHANNELS, _UNKNOWN, np.uint8)  # of each channel
        self.own_topics: set[str] = set()
        self.foreign: set[str] = set()
        self.start_publish_ns = 0
        self.first_log_ns = 0
        self._unknown_channels = 0
        self.events: list[Event] = []

    def take(self, buffer: np.ndarray, messages: np.ndarray) -> None:
        """One batch, see mcap_scan."""
        if self._begin is not None:
            self._begin(self.contents.metadata, self.contents.attachments)
            self._begin = None
        if not self.first_log_ns:
            self.first_log_ns = int(messages["log_time_ns"][0])
        counts = np.bincount(messages["channel"], minlength=_CHANNELS)
        channels = np.flatnonzero(counts)
        for channel in channels[self._kind[channels] == _UNKNOWN].tolist():
            self._know(channel, int(counts[channel]))
        channels = channels[self._kind[channels] >= _OWN]
        ratio, budget = self.scanner.read_ratio(), self.scanner.budget
        for channel, part in _by_channel(messages, channels, counts):
            if self._kind[channel] == _EVENTS:
                self._take_events(buffer, part[part["channel"] == channel])
                continue
            target = self._buffers[channel]
            if target.topic == "/rt/tick" and not self.start_publish_ns:
                first = np.flatnonzero(part["channel"] == channel)[0]
                self.start_publish_ns = int(part["publish_time_ns"][first])
            target.take(buffer, part, channel, int(counts[channel]), ratio, budget)

    def _know(self, channel: int, count: int) -> None:
        """Find out whose a channel is; one that the log has not defined (yet) stays unknown."""
        if channel not in self.contents.channels:
            self._unknown_channels += count
            return
        self._kind[channel], target = self._open(channel)
        if target is not None:
            self._buffers[channel] = target
        if len(self._buffers) > OWN_CHANNELS_MAX:
            raise LogError(
                str(self.scanner.path),
                f"more than {OWN_CHANNELS_MAX} channels hold topics of a bench",
                f"{OWN_CHANNELS_MAX}; a bench of 32 axes has some 140",
                "no bench writes this; ask where the file comes from",
            )

    def _take_events(self, buffer: np.ndarray, messages: np.ndarray) -> None:
        for message in messages[: max(0, _EVENTS_MAX - len(self.events))]:
            data = buffer[message["offset"] : message["offset"] + message["size"]].tobytes()
            try:
                self.events.append(_event(data))
            except (struct.error, ValueError):
                self.contents.note("a message of /log is damaged and was left out")

    def buffers_in_order(self) -> list[_Topic]:
        """Buffers with records, a topic once."""
        merged: dict[str, _Topic] = {}
        for target in self._buffers.values():
            if target.topic not in merged or target.count > merged[target.topic].count:
                merged[target.topic] = target
        return list(merged.values())

    def missing_fields(self) -> dict[str, tuple[str, ...]]:
        """Fields that were asked for and are not in the log, by topic."""
        found = (target for target in self._buffers.values() if target is not None and target.missing)
        return {target.topic: target.missing for target in found}

    def note_damage(self) -> None:
        """Tell what was left out."""
        if self._unknown_channels:
            self.contents.note(f"{self._unknown_channels} messages belong to no channel the log defines")
        for target in self._buffers.values():
            if target.other_size:
                self.contents.note(f"{target.topic}: {target.other_size} messages have another size than their schema")
            if target.missing:
                names = ", ".join(target.missing)
                self.contents.note(f"{target.topic}: written by another version, without {names}; read as 0")

    def _open(self, channel: int) -> tuple[int, _Topic | None]:
        """(kind, who takes its messages)."""
        topic, schema_id, encoding = self.contents.channels[channel]
        schema_name, schema_encoding, text = self.contents.schemas.get(schema_id, ("", "", ""))
        if (schema_name, encoding) == ("rcl_interfaces/msg/Log", "cdr"):
            return _EVENTS, None
        own = schema.own_layout(topic)
        wire = schema.layout_of(text) if (encoding, schema_encoding) == ("cdr", "ros2msg") else None
        if own is None or wire is None or not set(own.names[2:]) & set(wire.names):
            self.foreign.add(topic)
            return _FOREIGN, None
        if topic in ("/can/rx", "/can/tx") and "data" in wire.names:
            size = wire["data"].shape[0] if wire["data"].shape else 1
            if not 1 <= size <= _CAN_DATA_BYTES_MAX:
                self.foreign.add(topic)
                return _FOREIGN, None
            own = records.can_frame_record(size)
        self._add_own(topic)
        consumer = next((one for pattern, one in self._consumers.items() if fnmatch.fnmatchcase(topic, pattern)), None)
        if self._columns is None:
            return _OWN, _Topic(topic, wire, own, consumer)
        for pattern, names in self._columns.items():
            if fnmatch.fnmatchcase(topic, pattern):
                return _OWN, _Topic(topic, wire, schema.select(own, names), consumer)
        return _FOREIGN, None  # ours, and nobody asked for it

    def _add_own(self, topic: str) -> None:
        self.own_topics.add(topic)
        axes = {name.split("/")[1] for name in self.own_topics} - {"rt", "can"}
        if len(axes) > AXES_MAX:
            raise LogError(
                str(self.scanner.path),
                f"topics of more than {AXES_MAX} axes",
                "32 axes, as a profile may have",
                "no bench writes this; ask where the file comes from",
            )


def _by_channel(messages: np.ndarray, channels: np.ndarray, counts: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(channel, messages in which its own are, in order). Where there are many, each gets its own only: one look at all
    messages a channel would take minutes for a log of 65,000."""
    if len(channels) <= _FEW_CHANNELS:
        yield from ((channel, messages) for channel in channels.tolist())
        return
    wanted = np.zeros(_CHANNELS, bool)
    wanted[channels] = True
    messages = messages[wanted[messages["channel"]]]
    messages = messages[np.argsort(messages["channel"].astype(np.uint16), kind="stable")]
    end = 0
    for channel in channels.tolist():
        start, end = end, end + int(counts[channel])
        yield channel, messages[start:end]


def _schema_texts(contents: Contents) -> dict[str, str]:
    """The text of every topic's schema."""
    return {topic: contents.schemas.get(number, ("", "", ""))[2] for topic, number, _ in contents.channels.values()}


def _event(data: bytes) -> Event:
    """Decode rcl_interfaces/msg/Log (plain CDR, little-endian): time, level, name, text, …"""
    seconds, nanoseconds, level = struct.unpack_from("<iIB", data, 4)
    place, texts = 4 + 9, []
    for _ in range(2):
        place = 4 + -(-(place - 4) // 4) * 4
        (size,) = struct.unpack_from("<I", data, place)
        if size > len(data) - place - 4:
            raise ValueError("text longer than its message")
        texts.append(data[place + 4 : place + 4 + size].rstrip(b"\0").decode("utf-8", "replace"))
        place += 4 + size
    name, text = (one if len(one) <= _EVENT_CHARACTERS_MAX else one[:_EVENT_CHARACTERS_MAX] + "…" for one in texts)
    return Event(seconds * 1_000_000_000 + nanoseconds, level, name, text)
