"""An MCAP checker written from the specification (mcap.dev/spec), sharing no code with the writer or with `mcap`.

`examine(path)` returns a list of faults (empty: the file is sound) and what the file holds.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
SEAL = 0x80  # ours, private by the specification: bytes before it, their CRC-32
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(8, 16)


@dataclass
class Findings:
    faults: list[str] = field(default_factory=list)
    topics: dict[int, str] = field(default_factory=dict)
    messages: dict[str, list[tuple[int, int, int, bytes]]] = field(default_factory=dict)  # sequence, log, publish, data
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    chunk_count: int = 0
    has_summary: bool = False

    def expect(self, holds: bool, fault: str) -> None:
        if not holds:
            self.faults.append(fault)


class Reader:
    def __init__(self, data: bytes, place: int = 0) -> None:
        self.data = data
        self.place = place

    def number(self, form: str) -> int:
        (value,) = struct.unpack_from("<" + form, self.data, self.place)
        self.place += struct.calcsize("<" + form)
        return value

    def raw(self, size: int) -> bytes:
        assert self.place + size <= len(self.data), "longer than its record"
        self.place += size
        return self.data[self.place - size : self.place]

    def text(self) -> str:
        return self.raw(self.number("I")).decode()

    def text_map(self) -> dict[str, str]:
        end = self.number("I") + self.place
        found = {}
        while self.place < end:
            key = self.text()
            found[key] = self.text()
        return found


def split(data: bytes, start: int, end: int):
    """(opcode, offset of the record, content) of every record."""
    place = start
    while place < end:
        opcode, size = struct.unpack_from("<BQ", data, place)
        assert place + 9 + size <= end, f"record at {place} is cut"
        yield opcode, place, data[place + 9 : place + 9 + size]
        place += 9 + size


def examine(path: str | Path) -> Findings:
    data = Path(path).read_bytes()
    found = Findings()
    found.expect(data[:8] == MAGIC, "no magic at the start")
    found.expect(data[-8:] == MAGIC, "no magic at the end")
    all_records = list(split(data, 8, len(data) - 8))
    opcodes = [opcode for opcode, _, _ in all_records]
    found.expect(opcodes[0] == HEADER, "the first record is no header")
    found.expect(opcodes[-1] == FOOTER, "the last record is no footer")
    found.expect(opcodes.count(DATA_END) == 1, "not one DataEnd")
    end_at = opcodes.index(DATA_END)
    chunks = _data_section(found, data, all_records[: end_at + 1])
    _footer(found, data, all_records, end_at)
    _summary(found, data, all_records[end_at + 1 : -1], chunks, all_records[:end_at])
    return found


def _data_section(found: Findings, data: bytes, section: list) -> list[dict]:
    schemas: set[int] = set()
    chunks: list[dict] = []
    for opcode, offset, content in section:
        reader = Reader(content)
        if opcode == SCHEMA:
            schemas.add(reader.number("H"))
        elif opcode == CHANNEL:
            channel, schema = reader.number("H"), reader.number("H")
            found.expect(schema in schemas, f"channel {channel} before its schema {schema}")
            found.topics[channel] = reader.text()
            found.messages.setdefault(found.topics[channel], [])
        elif opcode == CHUNK:
            chunks.append(_chunk(found, offset, content))
        elif opcode == MESSAGE_INDEX:
            _message_index(found, chunks[-1], offset, content)
        elif opcode == METADATA:
            found.metadata.append((reader.text(), reader.text_map()))
        elif opcode == ATTACHMENT:
            reader.raw(16)
            name, _ = reader.text(), reader.text()
            found.attachments[name] = reader.raw(reader.number("Q"))
            crc = reader.number("I")
            found.expect(crc in (0, zlib.crc32(content[:-4])), f"attachment {name}: wrong checksum")
        elif opcode == DATA_END:
            crc = reader.number("I")
            found.expect(crc in (0, zlib.crc32(data[:offset])), "data section: wrong checksum")
        elif opcode == SEAL:
            before, crc = reader.number("Q"), reader.number("I")
            found.expect((before, crc) == (offset, zlib.crc32(data[:offset])), f"seal at {offset}: wrong")
            found.expect(len(content) == 12, f"seal at {offset}: {len(content)} bytes")
        else:
            found.expect(opcode == HEADER, f"record {opcode} in the data section")
    for chunk in chunks:
        found.expect(not chunk["unindexed"], f"chunk at {chunk['offset']}: {len(chunk['unindexed'])} not indexed")
    found.chunk_count = len(chunks)
    return chunks


def _chunk(found: Findings, offset: int, content: bytes) -> dict:
    reader = Reader(content)
    start, end, size, crc = (reader.number(form) for form in "QQQI")
    compression = reader.text()
    packed = reader.raw(reader.number("Q"))
    unpack = {
        "zstd": lambda: zstandard.ZstdDecompressor().decompress(packed, max_output_size=size),
        "lz4": lambda: lz4.frame.decompress(packed),
        "": lambda: packed,
    }[compression]
    data = unpack()
    found.expect(reader.place == len(content), f"chunk at {offset}: bytes behind its records")
    found.expect(len(data) == size, f"chunk at {offset}: {len(data)} bytes, says {size}")
    found.expect(zlib.crc32(data) == crc, f"chunk at {offset}: wrong checksum")
    chunk = {"offset": offset, "size": len(content) + 9, "data": data, "start": start, "end": end}
    chunk |= {"compression": compression, "packed": len(packed), "unindexed": {}, "counts": {}, "indexes": {}}
    times = []
    for opcode, place, message in split(data, 0, len(data)):
        found.expect(opcode == MESSAGE, f"chunk at {offset}: record {opcode} inside")
        channel, sequence, log, publish = struct.unpack_from("<HIQQ", message)
        found.expect(channel in found.topics, f"message of unknown channel {channel}")
        kept = found.messages[found.topics[channel]]
        found.expect(not kept or sequence == (kept[-1][0] + 1) & 0xFFFFFFFF, f"channel {channel}: sequence gap")
        kept.append((sequence, log, publish, message[22:]))
        chunk["unindexed"][place] = (channel, log)
        chunk["counts"][channel] = chunk["counts"].get(channel, 0) + 1
        times.append(log)
    found.expect(times == sorted(times), f"chunk at {offset}: messages out of order")
    found.expect((min(times), max(times)) == (start, end), f"chunk at {offset}: wrong time range")
    return chunk


def _message_index(found: Findings, chunk: dict, offset: int, content: bytes) -> None:
    reader = Reader(content)
    channel = reader.number("H")
    chunk["indexes"][channel] = offset
    chunk["index_end"] = offset + 9 + len(content)
    size = reader.number("I")
    found.expect(6 + size == len(content), "message index of another size than it says")
    for _ in range(size // 16):
        log, place = reader.number("Q"), reader.number("Q")
        there = chunk["unindexed"].pop(place, None)
        found.expect(there == (channel, log), f"message index points to {there}, not to channel {channel} at {log}")


def _footer(found: Findings, data: bytes, all_records: list, end_at: int) -> None:
    _, footer_offset, content = all_records[-1]
    summary_start, offset_start, crc = struct.unpack("<QQI", content)
    found.has_summary = summary_start > 0
    if not found.has_summary:
        return
    found.expect(summary_start == all_records[end_at + 1][1], "summary does not start behind DataEnd")
    found.expect(crc == zlib.crc32(data[summary_start : footer_offset + 25]), "summary: wrong checksum")
    opcode = data[offset_start]
    found.expect(opcode == SUMMARY_OFFSET, f"summary offsets start with record {opcode}")


def _summary(found: Findings, data: bytes, summary: list, chunks: list[dict], section: list) -> None:
    indexed_chunks, groups, counted = [], {}, None
    pointers = {ATTACHMENT: [], METADATA: []}
    for opcode, offset, content in summary:
        if opcode != SUMMARY_OFFSET:
            start, size = groups.get(opcode, (offset, 0))
            groups[opcode] = (start, size + len(content) + 9)
        reader = Reader(content)
        if opcode == CHUNK_INDEX:
            indexed_chunks.append(_chunk_index(reader))
        elif opcode in (ATTACHMENT_INDEX, METADATA_INDEX):
            kind = ATTACHMENT if opcode == ATTACHMENT_INDEX else METADATA
            place, size = reader.number("Q"), reader.number("Q")
            pointers[kind].append((place, size))
        elif opcode == STATISTICS:
            counted = [reader.number(form) for form in "QHIIIIQQ"]
            end = reader.number("I") + reader.place
            by_channel = {}
            while reader.place < end:
                channel = reader.number("H")
                by_channel[channel] = reader.number("Q")
        elif opcode == SUMMARY_OFFSET:
            group, start, size = reader.number("B"), reader.number("Q"), reader.number("Q")
            found.expect(groups[group] == (start, size), f"summary offset of group {group} is wrong")
    if not found.has_summary:
        return
    expected = [
        (c["start"], c["end"], c["offset"], c["size"], c["indexes"], c["index_end"] - c["offset"] - c["size"])
        + (c["compression"], c["packed"], len(c["data"]))
        for c in chunks
    ]
    found.expect(indexed_chunks == expected, "chunk indexes differ from the chunks")
    for kind, places in pointers.items():
        there = [(offset, len(content) + 9) for opcode, offset, content in section if opcode == kind]
        found.expect(places == there, f"index of records {kind} is wrong")
    kinds = [opcode for opcode, _, _ in section]
    counts = {topic: len(kept) for topic, kept in found.messages.items()}
    total = [sum(counts.values()), *(kinds.count(k) for k in (SCHEMA, CHANNEL, ATTACHMENT, METADATA, CHUNK))]
    span = [min((c["start"] for c in chunks), default=0), max((c["end"] for c in chunks), default=0)]
    found.expect(counted == total + span, f"statistics {counted}, counted {total + span}")
    named = {found.topics[channel]: count for channel, count in by_channel.items()}
    found.expect(named == {t: n for t, n in counts.items() if n}, "statistics by channel differ")
    repeated = [(o, c) for o, _, c in summary if o in (SCHEMA, CHANNEL)]
    first = [(o, c) for o, _, c in section if o in (SCHEMA, CHANNEL)]
    found.expect(sorted(repeated) == sorted(first), "schemas or channels of the summary differ")


def _chunk_index(reader: Reader) -> tuple:
    start, end, offset, size = (reader.number("Q") for _ in range(4))
    end_of_map = reader.number("I") + reader.place
    indexes = {}
    while reader.place < end_of_map:
        channel = reader.number("H")
        indexes[channel] = reader.number("Q")
    return start, end, offset, size, indexes, reader.number("Q"), reader.text(), reader.number("Q"), reader.number("Q")
