"""Seals: small records that say, on the way, which bytes of a log have been written so far.

A finished MCAP file carries one checksum over all of its data, behind the data. A log whose writer was killed has no end, so
each chunk is followed by a seal: the number of bytes before it and their CRC-32. It is a private record (the MCAP specification
keeps opcodes from 0x80 on for applications), so that other programs pass it over.
"""

import struct

OPCODE = 0x80
_CONTENT = struct.Struct("<QI")  # bytes of the file before the seal, their CRC-32
SIZE_BYTES = 9 + _CONTENT.size


def seal_record(size_bytes: int, crc: int) -> bytes:
    """The record, to stand at file offset `size_bytes`; `crc` is the CRC-32 of everything before it."""
    return struct.pack("<BQ", OPCODE, _CONTENT.size) + _CONTENT.pack(size_bytes, crc)


def read_seal(content: bytes | memoryview) -> tuple[int, int]:
    """(bytes before the seal, their CRC-32) of a record's content; struct.error when it has another size."""
    return _CONTENT.unpack(content)
