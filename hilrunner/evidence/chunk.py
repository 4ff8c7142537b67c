"""The content of an MCAP chunk: whole, or as much as a cut or damaged one still gives."""

import struct
import zlib
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard

from hilrunner.evidence import mcap_walk
from hilrunner.evidence.budget import CHUNK_BYTES_MAX

_HEAD = struct.Struct("<QQQII")  # start time, end time, uncompressed size, uncompressed crc, length of compression name
_FEED_BYTES = 512  # of a damaged chunk at a time: so few can unpack to no more than 16 MB
_LARGEST_WINDOW_BYTES = 1 << 27  # of a Zstandard frame: what the library's own decompressor allows
_LZ4_MAGIC = 0x184D2204


@dataclass(frozen=True)
class Chunk:
    """Decompressed records of one chunk and what was wrong with it (empty: nothing)."""

    content: bytes
    damage: str


def read_chunk(data: bytes | memoryview, is_cut: bool) -> Chunk:
    """Decompress a chunk record.

    Args:
        data: the record's content, possibly cut short.
        is_cut: the file ended inside the record.
    """
    if len(data) < _HEAD.size:
        return Chunk(b"", "chunk header cut off")
    _, _, size, crc, name_size = _HEAD.unpack_from(data)
    start = _HEAD.size + name_size + 8
    if name_size > 64 or len(data) < start:
        return Chunk(b"", "chunk header cut off" if is_cut else "chunk header damaged")
    name = bytes(data[_HEAD.size : _HEAD.size + name_size]).decode("utf-8", "replace")
    (packed_size,) = struct.unpack_from("<Q", data, start - 8)
    packed = data[start : start + packed_size]
    if not is_cut and len(packed) < packed_size:
        return Chunk(b"", "chunk header damaged")
    if size > CHUNK_BYTES_MAX:
        return Chunk(
            b"",
            f"chunk header damaged: it claims {size} bytes, allowed: {CHUNK_BYTES_MAX}; remedy: if another tool wrote "
            "this file, write it again with smaller chunks",
        )
    if name not in ("", "zstd", "lz4"):
        return Chunk(b"", f"chunk compressed with '{name}', which this version cannot read")
    content = bytes(packed) if name == "" else b"" if is_cut else _unpack(name, packed, size)
    if len(content) != size and name:
        content = _unpack_partly(name, packed, size)
    if is_cut:
        return Chunk(content, f"chunk cut off after {len(content)} of {size} bytes")
    if len(content) != size:
        return Chunk(content, f"chunk damaged: {len(content)} of {size} bytes could be unpacked")
    if crc and zlib.crc32(content) != crc:
        return Chunk(content, "chunk's checksum does not match its content")
    return Chunk(content, "")


def _unpack(name: str, packed, size: int) -> bytes:
    """The whole content, `size` bytes as the header promises; anything else, and a claim beyond, gives nothing here."""
    try:
        if name == "zstd":
            # a frame tells its own size, and the library takes that much memory, whatever it is asked for
            told = zstandard.frame_content_size(packed)
            if told > size:
                return b""
            unpacker = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW_BYTES)
            return unpacker.decompress(bytes(packed), max_output_size=size)
        unpacker = lz4.frame.LZ4FrameDecompressor()
        content = unpacker.decompress(packed, max_length=size + 1)
        return content if unpacker.eof else b""
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError):
        return b""


def _unpack_partly(name: str, packed, size: int) -> bytes:
    if name == "zstd":
        return _unpack_zstd_partly(packed, size)
    return _unpack_lz4_partly(packed, size)


def _unpack_zstd_partly(packed, size: int) -> bytes:
    """Whole blocks before the cut or damage; a Zstandard block cannot be decoded in part."""
    parts, count = [], 0
    stream = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW_BYTES).decompressobj()
    try:
        for start in range(0, len(packed), _FEED_BYTES):
            parts.append(stream.decompress(bytes(packed[start : start + _FEED_BYTES])))
            count += len(parts[-1])
            if stream.eof or count >= size:
                break
    except (zstandard.ZstdError, MemoryError):
        pass
    return b"".join(parts)[:size]


def _unpack_lz4_partly(packed, size: int) -> bytes:
    """Every byte before the cut: LZ4 sequences are byte-serial (LZ4 frame format 1.6)."""
    if len(packed) < 7 or struct.unpack_from("<I", packed)[0] != _LZ4_MAGIC:
        return b""
    flags = packed[4]
    first_block = 7 + (8 if flags & 0x08 else 0) + (4 if flags & 0x01 else 0)
    source = np.frombuffer(packed, np.uint8)
    target = np.zeros(size, np.uint8)
    count = mcap_walk.decode_lz4_blocks(source, len(source), first_block, bool(flags & 0x10), target)
    return target[:count].tobytes()
