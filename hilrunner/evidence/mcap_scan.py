"""An MCAP file read from front to end, in any state: whole, unfinished, cut, damaged.

The file is read in windows; runs of messages are noted by the compiled walk, also at top level (files without chunks),
chunks are unpacked into a batch, so that Python works per batch and not per message. Memory: one window and one batch.
"""

import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilrunner.base.errors import LogError
from hilrunner.base.plain_text import plain_line
from hilrunner.evidence import mcap_walk
from hilrunner.evidence.budget import DAMAGED_PLACES_MAX, RECORD_BYTES_MAX, Budget
from hilrunner.evidence.chunk import read_chunk
from hilrunner.evidence.damaged import DamagedLogError
from hilrunner.evidence.mcap_ending import MAGIC, check_ending, looks_ended
from hilrunner.evidence.mcap_window import HUGE, Window
from hilrunner.record import seal

BATCH_BYTES = 8 << 20
BATCH_MESSAGES = 1 << 17
_DAMAGE_NOTES_MAX = 20
_TOP_LEVEL = frozenset((*range(0x01, 0x10), seal.OPCODE))  # opcodes of the format, and our own
_DATA_END_BYTES = mcap_walk.RECORD_HEADER_BYTES + 4
_U64 = struct.Struct("<Q")


@dataclass
class Contents:
    """What a scan collects beside the messages."""

    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)  # id -> name, encoding, text
    channels: dict[int, tuple[str, int, str]] = field(default_factory=dict)  # id -> topic, schema id, encoding
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, tuple[str, bytes]] = field(default_factory=dict)  # name -> media type, data
    library: str = ""
    finished: bool = False
    damage: list[str] = field(default_factory=list)
    damage_count: int = 0
    mismatches: list[str] = field(default_factory=list)

    @property
    def is_own(self) -> bool:
        """Written by this program, which leaves no checksum out."""
        return self.library.startswith("hilrunner")

    def note(self, text: str) -> None:
        """Remember what is missing; the first ones word by word, the rest as a count."""
        self.damage_count += 1
        if len(self.damage) < _DAMAGE_NOTES_MAX:
            self.damage.append(plain_line(text))

    def harm(self, text: str) -> None:
        """Remember a part that is not what was written: unlike one that was cut off, it can have changed what is read."""
        self.note(text)
        if len(self.mismatches) < _DAMAGE_NOTES_MAX:
            self.mismatches.append(plain_line(text))


Batch = Callable[[np.ndarray, np.ndarray], None]  # (buffer u1, messages MESSAGE)


def scan(path: str | Path, on_batch: Batch) -> Contents:
    """Read the whole file; `on_batch(buffer, messages)` gets every run of messages, in file order.

    Channels of a batch's messages are in the returned object's `channels` before the batch is handed over; the object is
    the one `on_batch` can see through `Scanner.contents`. Raises LogError when the file cannot be read or is no MCAP file.
    """
    return Scanner(path, on_batch).run()


class Scanner:
    """One pass over one file."""

    def __init__(self, path: str | Path, on_batch: Batch) -> None:
        self.path = Path(path)
        self.contents = Contents()
        self.budget = Budget(str(self.path), 0)
        self._on_batch = on_batch
        self._messages = np.zeros(BATCH_MESSAGES, mcap_walk.MESSAGE)
        self._batch = np.empty(BATCH_BYTES, np.uint8)
        self._batch_size = 0
        self._window: Window | None = None
        self._ended = False  # the file has an end: what does not parse before it is damage, not a cut
        self._segments: list[tuple[int, int, int]] = []  # start, end in the batch; offset of the chunk in the file
        self._damaged_places = 0

    def run(self) -> Contents:
        """See `scan`."""
        try:
            with open(self.path, "rb", buffering=0, opener=_open_at_once) as file:
                self._check_kind(file)
                self._check_magic(file)
                self._scan(file)
        except OSError as error:
            raise LogError(str(self.path), f"cannot be read: {error.strerror or error}", remedy="name a log") from None
        self._flush()
        return self.contents

    def read_ratio(self) -> float:
        """How much of the file has been taken, 0..1."""
        if self._window is None or not self._window.size:
            return 1.0
        return self._window.file_offset / self._window.size

    def _check_kind(self, file) -> None:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise LogError(str(self.path), "no regular file, so it has no end", "an MCAP log", "name a log")
        self.budget = Budget(str(self.path), found.st_size)

    def _check_magic(self, file) -> None:
        head = file.read(len(MAGIC))
        if not head:
            raise LogError(
                str(self.path), "empty file (0 bytes)", "an MCAP log", "the run wrote nothing: look at its messages"
            )
        if head != MAGIC:
            if looks_ended(Window(file, 0)):
                raise DamagedLogError(str(self.path), f"damaged: it ends as a log, and begins with {head!r}")
            kind = f"cut off after {len(head)} bytes" if MAGIC.startswith(head) else f"begins with {head!r}"
            raise LogError(
                str(self.path), f"not an MCAP file: {kind}", f"a file that begins with {MAGIC!r}", "name a log"
            )

    def _scan(self, file) -> None:
        window = self._window = Window(file, len(MAGIC))
        self._ended = looks_ended(window)
        while window.remaining:
            place = window.file_offset
            buffer, start, end, size = window.view_record()
            opcode = int(buffer[start])
            if size == HUGE:
                self.contents.harm(
                    f"damaged at byte {place}: a record of more than {RECORD_BYTES_MAX} bytes begins there, "
                    "and no bench writes one"
                )
                if not self._resume(window, place):
                    break
            elif size < 0:  # the record, or its header, reaches past the end of the file
                self._take_cut(buffer, start, end, place)
                if not self._resume(window, place):
                    break
            elif opcode == mcap_walk.OPCODE_MESSAGE:
                stop = self._take_messages(buffer, start, end)
                if stop > start:
                    window.consume(stop - start)
                elif not self._skip_damage(window, place):
                    break
            elif opcode == 0 or (opcode == mcap_walk.OPCODE_DATA_END and size != _DATA_END_BYTES):
                if not self._skip_damage(window, place):
                    break
            else:
                self.budget.look_at()
                content = memoryview(buffer)[start + mcap_walk.RECORD_HEADER_BYTES : start + size]
                self._take_record(opcode, content, False, place)
                if opcode == mcap_walk.OPCODE_DATA_END:
                    (stored,) = struct.unpack("<I", content)
                    check_ending(self.contents, window, stored, window.crc, place + size)
                    break
                window.consume(size)
        if not self.contents.finished:
            told = f"not finished: the file ends at byte {window.size} without its end mark"
            self._note_end(told, f"damaged: the file has an end mark at byte {window.size}, but its data has no end")

    def _note_end(self, lacking: str, harmed: str) -> None:
        """What a missing end means: the writer was stopped, or (where the file was ended) its records are damaged."""
        if self._ended:
            self.contents.harm(harmed)
        else:
            self.contents.note(lacking)

    def _take_messages(self, buffer: np.ndarray, start: int, end: int) -> int:
        """Top-level messages, handed over at once; returns the position after them."""
        self._flush()
        _, stop, count = mcap_walk.walk(buffer, start, end, self._messages, 0)
        if count:
            self._on_batch(buffer, self._messages[:count])
        return stop

    def _take_cut(self, buffer: np.ndarray, start: int, end: int, place: int) -> None:
        """What a record without its end still gives."""
        if int(buffer[start]) not in _TOP_LEVEL:
            self.contents.harm(f"damaged at byte {place}: no record begins there")
            return
        content = memoryview(buffer)[min(start + mcap_walk.RECORD_HEADER_BYTES, end) : end]
        self._note_end(
            f"cut off at byte {place + end - start}, inside a record that begins at byte {place}",
            f"damaged: the record at byte {place} claims to reach past the end of the file",
        )
        self._take_record(int(buffer[start]), content, True, place)

    def _skip_damage(self, window: "Window", place: int) -> bool:
        if not self._ended and window.rest_is_zero():
            self.contents.note(
                f"cut off at byte {place}: nothing but zeros follows, the data for them was never stored"
            )
            return False
        self.contents.harm(f"damaged at byte {place}: no record begins there")
        return self._resume(window, place)

    def _resume(self, window: "Window", place: int) -> bool:
        """Go on at the next chunk that can be recognised; False when there is none, or too much is damaged."""
        self._damaged_places += 1
        if self._damaged_places > DAMAGED_PLACES_MAX:
            self.contents.note(
                f"more than {DAMAGED_PLACES_MAX} places are damaged: nothing behind byte {place} is read"
            )
            return False
        found = window.find_chunk(place + 1)
        if found < 0:
            return False
        self.contents.harm(f"damaged between bytes {place} and {found}: reading goes on with the chunk there")
        window.move_to(found)
        return True

    def _take_record(self, opcode: int, data: memoryview, is_cut: bool, place: int) -> None:
        if opcode == mcap_walk.OPCODE_CHUNK:
            self._take_chunk(data, is_cut, place)
            return
        if opcode == mcap_walk.OPCODE_DATA_END:
            self.contents.finished = not is_cut
            return
        if is_cut:
            return
        try:
            if opcode == seal.OPCODE:
                self._check_seal(data, place)
            else:
                _take_definition(self.contents, opcode, data, self.budget)
        except (struct.error, UnicodeDecodeError, ValueError):
            self.contents.harm(f"a record (opcode {opcode}) at byte {place} is damaged and was left out")

    def _check_seal(self, data: memoryview, place: int) -> None:
        size_bytes, crc = seal.read_seal(data)
        if self._window.crc is not None and (size_bytes, crc) != (place, self._window.crc):
            self.contents.harm(f"the seal at byte {place} does not match the bytes before it")

    def _take_chunk(self, data: memoryview, is_cut: bool, place: int) -> None:
        chunk = read_chunk(data, is_cut)
        if chunk.damage and is_cut and not self._ended:
            self.contents.note(f"at byte {place}: {chunk.damage}")
        elif chunk.damage:
            self.contents.harm(f"at byte {place}: {chunk.damage}")
        size = len(chunk.content)
        self.budget.unpack(size)
        if self._batch_size + size > len(self._batch):
            self._flush()
            if size > len(self._batch):
                self._batch = np.empty(size, np.uint8)
        start = self._batch_size
        self._batch[start : start + size] = np.frombuffer(chunk.content, np.uint8)
        self._batch_size += size
        self._segments.append((start, start + size, -1 if is_cut or chunk.damage else place))

    def _flush(self) -> None:
        """Walk the batched chunks and hand their messages over."""
        count = 0
        for start, end, place in self._segments:
            position = start
            while position < end:
                code, position, count = mcap_walk.walk(self._batch, position, end, self._messages, count)
                if code == mcap_walk.WALK_FULL:
                    self._hand_over(count)
                    count = 0
                elif code == mcap_walk.WALK_STOPPED:
                    position, count = self._take_inner(position, end, count)
                elif code == mcap_walk.WALK_CUT:
                    if place >= 0:
                        self.contents.harm(f"the chunk at byte {place} ends inside a record")
                    break
        self._hand_over(count)
        self._segments.clear()
        self._batch_size = 0

    def _hand_over(self, count: int) -> None:
        if count:
            self._on_batch(self._batch, self._messages[:count])

    def _take_inner(self, position: int, end: int, count: int) -> tuple[int, int]:
        """A schema, a channel or an unknown record within a chunk; returns (next position, messages still noted)."""
        opcode = int(self._batch[position])
        (length,) = _U64.unpack_from(self._batch[position + 1 : position + 9].tobytes())
        content = position + mcap_walk.RECORD_HEADER_BYTES
        if length > end - content or opcode == mcap_walk.OPCODE_MESSAGE or opcode == 0:
            return end, count
        self.budget.look_at()
        try:
            _take_definition(self.contents, opcode, memoryview(self._batch)[content : content + length], self.budget)
        except (struct.error, UnicodeDecodeError, ValueError):
            self.contents.harm("a record inside a chunk is damaged and was left out")
        return content + length, count


def _open_at_once(path: str, flags: int) -> int:
    """A pipe without a writer is opened without waiting for one, so that it can be refused."""
    return os.open(path, flags | os.O_NONBLOCK)


def _take_definition(contents: Contents, opcode: int, data: memoryview, budget: Budget) -> None:
    """Schemas, channels, metadata, attachments and the header; any other record is passed over."""
    if opcode == mcap_walk.OPCODE_SCHEMA:
        (number,) = struct.unpack_from("<H", data)
        name, place = _text(data, 2)
        encoding, place = _text(data, place)
        (size,) = struct.unpack_from("<I", data, place)
        schema = (name, encoding, bytes(data[place + 4 : place + 4 + size]).decode("utf-8"))
        if contents.schemas.get(number) != schema:  # some writers repeat them in every chunk
            budget.describe(len(data))
            contents.schemas[number] = schema
    elif opcode == mcap_walk.OPCODE_CHANNEL:
        number, schema_id = struct.unpack_from("<HH", data)
        topic, place = _text(data, 4)
        channel = (topic, schema_id, _text(data, place)[0])
        if contents.channels.get(number) != channel:
            budget.describe(len(data))
            contents.channels[number] = channel
    elif opcode == mcap_walk.OPCODE_METADATA:
        budget.describe(len(data))
        name, place = _text(data, 0)
        contents.metadata.setdefault(name, {}).update(_text_map(data, place))
    elif opcode == mcap_walk.OPCODE_ATTACHMENT:
        name, place = _text(data, 16)
        media_type, place = _text(data, place)
        (size,) = _U64.unpack_from(data, place)
        if size > len(data) - place - 8:
            raise ValueError("attachment longer than its record")
        budget.attach(size)
        contents.attachments[name] = (media_type, bytes(data[place + 8 : place + 8 + size]))
        (crc,) = struct.unpack_from("<I", data, place + 8 + size)
        if (crc or contents.is_own) and zlib.crc32(data[: place + 8 + size]) != crc:
            contents.harm(f"the attachment {name} does not match its checksum")
    elif opcode == 0x01:
        contents.library = _text(data, _text(data, 0)[1])[0]


def _text(data: memoryview, place: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, place)
    end = place + 4 + size
    if end > len(data):
        raise ValueError("text longer than its record")
    return bytes(data[place + 4 : end]).decode("utf-8"), end


def _text_map(data: memoryview, place: int) -> Iterator[tuple[str, str]]:
    (size,) = struct.unpack_from("<I", data, place)
    place += 4
    end = place + size
    while place < end:
        key, place = _text(data, place)
        value, place = _text(data, place)
        yield key, value
