"""MCAP records byte by byte, right or wrong on purpose (mcap.dev/spec)."""

import struct
import zlib

import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 9, 12, 15


def record(opcode: int, content: bytes, claimed: int | None = None) -> bytes:
    """One record; `claimed`: the length its head tells, whatever is there."""
    return struct.pack("<BQ", opcode, len(content) if claimed is None else claimed) + content


def text(value: str | bytes, claimed: int | None = None) -> bytes:
    """A string with its length in front."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data) if claimed is None else claimed) + data


def schema(number: int, name: str, definition: str | bytes, encoding: str = "ros2msg") -> bytes:
    return record(SCHEMA, struct.pack("<H", number) + text(name) + text(encoding) + text(definition))


def channel(number: int, schema_id: int, topic: str | bytes, encoding: str = "cdr") -> bytes:
    return record(CHANNEL, struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(number: int, data: bytes, time_ns: int = 1) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, time_ns, time_ns) + data)


def metadata(name: str | bytes, table: dict) -> bytes:
    pairs = b"".join(text(key) + text(value) for key, value in table.items())
    return record(METADATA, text(name) + struct.pack("<I", len(pairs)) + pairs)


def attachment(name: str | bytes, data: bytes, claimed: int | None = None, media_type: str = "text/plain") -> bytes:
    head = struct.pack("<QQ", 1, 1) + text(name) + text(media_type)
    content = head + struct.pack("<Q", len(data) if claimed is None else claimed) + data
    return record(ATTACHMENT, content + struct.pack("<I", zlib.crc32(content)))


def chunk(
    content: bytes,
    packed: bytes | None = None,
    name: str | bytes = "zstd",
    size: int | None = None,
    crc: int | None = None,
):
    """A chunk of `content`; the other arguments replace what would be right."""
    if packed is None:
        packed = zstandard.ZstdCompressor(level=1).compress(content) if name == "zstd" else content
    told = len(content) if size is None else size
    head = struct.pack("<QQQI", 1, 1, told, zlib.crc32(content) if crc is None else crc)
    return record(CHUNK, head + text(name) + struct.pack("<Q", len(packed)) + packed)


def file(*parts: bytes, library: str | bytes = "attack", finished: bool = True) -> bytes:
    """A whole file; with a right end, that its checksums do not give the attack away."""
    data = MAGIC + record(HEADER, text("") + text(library)) + b"".join(parts)
    if not finished:
        return data
    data += record(DATA_END, struct.pack("<I", zlib.crc32(data)))
    footer = struct.pack("<BQQQ", FOOTER, 20, 0, 0)
    return data + footer + struct.pack("<I", 0) + MAGIC
