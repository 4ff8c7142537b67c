"""A moving window over an MCAP file: the next whole record, and the next recognisable chunk after damage."""

import errno
import os
import struct
import zlib

import numpy as np

from hilrunner.evidence import mcap_walk
from hilrunner.evidence.budget import RECORD_BYTES_MAX

CUT, HUGE = -1, -2
WINDOW_BYTES = 8 << 20
_SEARCH_BYTES = 1 << 20
_CHUNK_NAMES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_NAME_OFFSET = mcap_walk.RECORD_HEADER_BYTES + 28  # of the compression's name in a chunk record
_U64 = struct.Struct("<Q")


class Window:
    """Reads `file` (unbuffered, binary) from `offset` on.

    `crc` is the CRC-32 of all bytes from the start of the file to the current place, as long as nothing was jumped over; None
    from the first `move_to` on.
    """

    def __init__(self, file, offset: int) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        self._buffer = np.empty(WINDOW_BYTES, np.uint8)
        self._start = self._end = 0
        self.file_offset = offset
        file.seek(0)
        self.crc: int | None = zlib.crc32(file.read(offset))

    @property
    def remaining(self) -> int:
        """Bytes of the file from the current place on."""
        return self.size - self.file_offset

    def move_to(self, offset: int) -> None:
        """Go on reading at `offset`; what the window holds of it already is not read again."""
        self.crc = None
        held = self._start + offset - self.file_offset
        if self._start <= held <= self._end:
            self._start = held
        else:
            self._start = self._end = 0
        self.file_offset = offset

    def consume(self, count: int) -> None:
        """Move on by `count` bytes."""
        if self.crc is not None:
            self.crc = zlib.crc32(self._buffer[self._start : self._start + count], self.crc)
        self._start += count
        self.file_offset += count

    def view_record(self) -> tuple[np.ndarray, int, int, int]:
        """(buffer, start, end, size of the record at `start`); size CUT: the file ends before it does, HUGE: no record is so long."""
        header = mcap_walk.RECORD_HEADER_BYTES
        self._need(header)
        if self.remaining < header:
            return self._buffer, self._start, self._end, CUT
        (length,) = _U64.unpack_from(self._buffer[self._start + 1 : self._start + header].tobytes())
        if length > self.remaining - header:
            self._need(min(self.remaining, _LARGEST_CUT_BYTES))
            return self._buffer, self._start, self._end, CUT
        if length > RECORD_BYTES_MAX:
            return self._buffer, self._start, self._end, HUGE
        self._need(header + length)
        return self._buffer, self._start, self._end, header + length

    def tail(self, count: int) -> bytes:
        """The last `count` bytes of the file (fewer where it is shorter), without moving on."""
        return self.bytes_at(max(0, self.size - count), count)

    def bytes_at(self, offset: int, count: int) -> bytes:
        """Bytes of the file from `offset` on, without moving on."""
        place = self._file.tell()
        self._file.seek(offset)
        data = self._file.read(count)
        self._file.seek(place)
        return data

    def rest_is_zero(self) -> bool:
        """Nothing but zeros follows: blocks the file system kept for data that never came. Moves on to the end."""
        while self.remaining:
            self._need(1)
            if self._buffer[self._start : self._end].any():
                return False
            self.consume(self._end - self._start)
            data = self._next_data(self.file_offset)
            if data > self.file_offset:  # zeros are the same for the checksum, which nothing asks for behind a cut
                self.move_to(data)
        return True

    def _next_data(self, offset: int) -> int:
        """Where the file has blocks again from `offset` on: a hole can be terabytes long, and reading it takes hours."""
        try:
            return os.lseek(self._file.fileno(), offset, os.SEEK_DATA)
        except OSError as error:
            return self.size if error.errno == errno.ENXIO else offset  # ENXIO: a hole to the end

    def find_chunk(self, offset: int) -> int:
        """File offset of the next compressed chunk from `offset` on whose header agrees with itself; -1: none."""
        position = offset
        while position < self.size:
            position = max(position, self._next_data(position) - _NAME_OFFSET)
            self._file.seek(position)
            data = self._file.read(_SEARCH_BYTES)
            for hit in _hits(data):
                start = position + hit - _NAME_OFFSET
                if start >= offset and self._is_chunk(start):
                    return start
            if position + len(data) >= self.size or not data:
                break
            position += max(1, len(data) - len(_CHUNK_NAMES[0]) + 1)
        return -1

    def _is_chunk(self, start: int) -> bool:
        self._file.seek(start)
        head = self._file.read(_NAME_OFFSET + 16)
        if len(head) < _NAME_OFFSET + 16 or head[0] != mcap_walk.OPCODE_CHUNK:
            return False
        (length,) = _U64.unpack_from(head, 1)
        (name_size,) = struct.unpack_from("<I", head, _NAME_OFFSET)
        (packed_size,) = _U64.unpack_from(head, _NAME_OFFSET + 4 + name_size)
        return length == 28 + 4 + name_size + 8 + packed_size

    def _need(self, least: int) -> None:
        if self._end - self._start >= min(least, self.remaining):
            return
        kept = self._buffer[self._start : self._end].copy()
        if least > len(self._buffer):
            self._buffer = np.empty(least, np.uint8)
        self._buffer[: len(kept)] = kept
        self._start, self._end = 0, len(kept)
        self._file.seek(self.file_offset + self._end)
        while self._end < len(self._buffer):
            count = self._file.readinto(memoryview(self._buffer)[self._end :])
            if not count:
                break
            self._end += count


_LARGEST_CUT_BYTES = 64 << 20  # of a record without its end, that much is looked at


def _hits(data: bytes) -> list[int]:
    places = []
    for name in _CHUNK_NAMES:
        place = data.find(name)
        while place >= 0:
            places.append(place)
            place = data.find(name, place + 1)
    return sorted(places)
