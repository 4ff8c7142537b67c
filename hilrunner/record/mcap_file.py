"""An MCAP file that stays readable whatever happens to the disk under it.

Goals: every append is whole or absent; a full disk costs the newest data and nothing else; the file can always be ended.
Assumptions: one writer, a regular file.
Invariants: the first `size_bytes` bytes are whole records; blocks for the ending (`_ending_size_bytes`) are allocated behind
them before a chunk is accepted, so that the summary still fits when the disk is full. Format: mcap.dev/spec.
"""

import contextlib
import ctypes
import errno
import os
import stat
import struct
import zlib
from pathlib import Path
from typing import NamedTuple, NoReturn

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hilrunner.base.errors import LogError
from hilrunner.record.file_lock import take_lock
from hilrunner.record.seal import seal_record

MAGIC = b"\x89MCAP0\r\n"
ALLOCATION_STEP_BYTES = 1 << 20  # blocks are taken ahead in steps of this size while there is room
ENDING_SPARE_BYTES = 16384  # DataEnd, footer, statistics, closing metadata
FALLOC_FL_KEEP_SIZE = 1
_OWN_ERRNOS = {
    errno.EBADF,
    errno.EFAULT,
    errno.EINVAL,
}  # of a write: a fault of this program; all others are the disk's
_NO_FALLOCATE_ERRNOS = {errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.ENODEV, errno.ESPIPE, errno.EINTR}

_libc = ctypes.CDLL(None, use_errno=True)
_libc.fallocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)

COUNT = struct.Struct("<HI")  # channel, messages


class WrittenChunk(NamedTuple):
    """What the summary must know of one chunk, and what is needed to take it back."""

    start_offset: int
    index_record: bytes  # the encoded ChunkIndex
    message_counts: bytes  # COUNT items: hours of chunks stay small in memory
    start_real_ns: int
    end_real_ns: int
    crc_before: int


def record_bytes(record) -> bytes:
    """One encoded MCAP record."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class McapFile:
    """Appends records, counts what the disk refused, ends the file in every case.

    Args:
        path: created or emptied; raises LogError when that, or writing the header, is impossible.
        library: the text that names the writer in the header.
    """

    def __init__(self, path: str | Path, library: str) -> None:
        self.path = Path(path)
        self.size_bytes = 0
        self.lost_bytes = 0
        self.lost_messages = 0
        self.chunks: list[WrittenChunk] = []
        self._crc = 0
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._attachment_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._index_size_bytes = 0
        self._counts: dict[int, int] = {}
        self._allocated_bytes = 0
        self._can_allocate = True
        self._in_head = True
        self._fd = self._open()
        self.append(MAGIC + record_bytes(Header(profile="", library=library)))

    def _open(self) -> int:
        """The file, locked as long as it is open and empty; what lies there is kept where the lock is another's."""
        try:
            fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise LogError(
                str(self.path),
                f"the log cannot be created: {error.strerror}",
                remedy="choose another --log or --no-log",
            ) from None
        try:
            if not take_lock(fd):
                raise LogError(
                    str(self.path), "another run is writing this log", remedy="name another file, or end that run"
                )
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise _cannot_write(self.path, "not a regular file")
            os.ftruncate(fd, 0)
        except OSError as error:
            os.close(fd)
            raise _cannot_write(self.path, error.strerror) from None
        except LogError:
            os.close(fd)
            raise
        return fd

    def is_in_place(self) -> bool:
        """Whether the name still leads to this file, which has not been deleted, replaced, or unmounted."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._fd))
        except OSError:
            return False

    def end_of_head(self) -> None:
        """From here on a refusing disk costs data; before, it is a LogError: nothing has been recorded yet."""
        self.append(seal_record(self.size_bytes, self._crc))
        self._in_head = False

    def append(self, data: bytes) -> bool:
        """Add whole records; False (and nothing added, the loss counted) when the disk refuses."""
        if not self._reserve(len(data) + self._ending_size_bytes()) or not self._write_all(data):
            if self._in_head:
                self._refuse("no space left, or the file size limit is reached")
            self.lost_bytes += len(data)
            return False
        self._crc = zlib.crc32(data, self._crc)
        self.size_bytes += len(data)
        return True

    def add_schema(self, schema: Schema) -> bool:
        """A schema, outside the chunks, repeated in the summary."""
        encoded = record_bytes(schema)
        self._schemas.append(encoded)
        return self.append(encoded)

    def add_channel(self, channel: Channel) -> bool:
        """A channel, outside the chunks, repeated in the summary."""
        encoded = record_bytes(channel)
        self._channels.append(encoded)
        return self.append(encoded)

    def add_attachment(self, name: str, media_type: str, data: bytes, real_ns: int) -> bool:
        """A file kept inside the log."""
        encoded = record_bytes(
            Attachment(create_time=real_ns, log_time=real_ns, name=name, media_type=media_type, data=data)
        )
        index = AttachmentIndex(
            offset=self.size_bytes,
            length=len(encoded),
            log_time=real_ns,
            create_time=real_ns,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        if not self.append(encoded):
            return False
        self._attachment_indexes.append(record_bytes(index))
        return True

    def add_metadata(self, name: str, values: dict[str, str]) -> bool:
        """A named table of texts; where a name comes twice, the later one holds."""
        encoded = record_bytes(Metadata(name=name, metadata=values))
        index = MetadataIndex(offset=self.size_bytes, length=len(encoded), name=name)
        if not self.append(encoded):
            return False
        self._metadata_indexes.append(record_bytes(index))
        return True

    def add_chunk(
        self,
        compressed: bytes,
        compression: str,
        uncompressed_size: int,
        uncompressed_crc: int,
        message_indexes: dict[int, bytes],
        message_counts: dict[int, int],
        start_real_ns: int,
        end_real_ns: int,
    ) -> bool:
        """A compressed chunk, its message indexes (channel -> encoded (time, offset) pairs) and a seal, together or not at all."""
        name = compression.encode()
        head = struct.pack("<QQQII", start_real_ns, end_real_ns, uncompressed_size, uncompressed_crc, len(name)) + name
        length = len(head) + 8 + len(compressed)
        parts = [struct.pack("<BQ", Opcode.CHUNK, length), head, struct.pack("<Q", len(compressed)), compressed]
        chunk_length = 9 + length
        position = self.size_bytes + chunk_length
        offsets = {}
        for channel, pairs in message_indexes.items():
            offsets[channel] = position
            parts += [struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(pairs), channel, len(pairs)), pairs]
            position += 9 + 6 + len(pairs)
        index_record = record_bytes(
            ChunkIndex(
                chunk_length=chunk_length,
                chunk_start_offset=self.size_bytes,
                compression=compression,
                compressed_size=len(compressed),
                message_end_time=end_real_ns,
                message_index_length=position - self.size_bytes - chunk_length,
                message_index_offsets=offsets,
                message_start_time=start_real_ns,
                uncompressed_size=uncompressed_size,
            )
        )
        counts = b"".join(COUNT.pack(*pair) for pair in message_counts.items())
        written = WrittenChunk(self.size_bytes, index_record, counts, start_real_ns, end_real_ns, self._crc)
        data = b"".join(parts)
        if not self.append(data + seal_record(self.size_bytes + len(data), zlib.crc32(data, self._crc))):
            self.lost_messages += sum(message_counts.values())
            return False
        self._index_size_bytes += len(index_record)
        for channel, count in message_counts.items():
            self._counts[channel] = self._counts.get(channel, 0) + count
        self.chunks.append(written)
        return True

    def message_counts(self) -> dict[int, int]:
        """Messages in the file, by channel."""
        return dict(self._counts)

    def close(self) -> None:
        """End the file; gives up the newest chunks, one by one, where the ending does not fit otherwise."""
        while not self._write_ending(self._ending()):
            if not self.chunks:
                self._write_ending(_short_ending(self._crc))
                break
            self._take_back_chunk()
        with contextlib.suppress(OSError):  # blocks allocated ahead stay; a disk that is gone has lost more than that
            os.ftruncate(self._fd, self.size_bytes)
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _refuse(self, why: str) -> NoReturn:
        if self.is_in_place():
            os.unlink(self.path)
        os.close(self._fd)
        raise _cannot_write(self.path, why)

    def _write_ending(self, ending: bytes) -> bool:
        if not self._write_all(ending):
            return False
        self.size_bytes += len(ending)
        return True

    def _take_back_chunk(self) -> None:
        chunk = self.chunks.pop()
        self._index_size_bytes -= len(chunk.index_record)
        for channel, count in COUNT.iter_unpack(chunk.message_counts):
            self._counts[channel] -= count
            self.lost_messages += count
        self.lost_bytes += self.size_bytes - chunk.start_offset
        # records written after the chunk go with it; their indexes must not point past the end
        self._attachment_indexes = [r for r in self._attachment_indexes if _offset_of(r) < chunk.start_offset]
        self._metadata_indexes = [r for r in self._metadata_indexes if _offset_of(r) < chunk.start_offset]
        self.size_bytes = chunk.start_offset
        self._crc = chunk.crc_before
        self._cut()

    def _ending_size_bytes(self) -> int:
        tables = (self._schemas, self._channels, self._attachment_indexes, self._metadata_indexes)
        return ENDING_SPARE_BYTES + self._index_size_bytes + sum(len(record) for table in tables for record in table)

    def _ending(self) -> bytes:
        """DataEnd, summary, summary offsets, footer, magic."""
        data_end = record_bytes(DataEnd(data_section_crc=self._crc))
        summary_start = self.size_bytes + len(data_end)
        groups = [
            (Opcode.SCHEMA, b"".join(self._schemas)),
            (Opcode.CHANNEL, b"".join(self._channels)),
            (Opcode.STATISTICS, record_bytes(self._statistics())),
            (Opcode.CHUNK_INDEX, b"".join(chunk.index_record for chunk in self.chunks)),
            (Opcode.ATTACHMENT_INDEX, b"".join(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, b"".join(self._metadata_indexes)),
        ]
        summary = b""
        offsets = b""
        for opcode, group in groups:
            if group:
                place = SummaryOffset(
                    group_opcode=opcode, group_start=summary_start + len(summary), group_length=len(group)
                )
                offsets += record_bytes(place)
                summary += group
        offset_start = summary_start + len(summary)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(head, zlib.crc32(offsets, zlib.crc32(summary)))
        return data_end + summary + offsets + head + struct.pack("<I", crc) + MAGIC

    def _statistics(self) -> Statistics:
        counts = {channel: count for channel, count in self._counts.items() if count}
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self.chunks),
            message_count=sum(counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=min((chunk.start_real_ns for chunk in self.chunks), default=0),
            message_end_time=max((chunk.end_real_ns for chunk in self.chunks), default=0),
            schema_count=len(self._schemas),
        )

    def _reserve(self, size_bytes: int) -> bool:
        """Allocate disk blocks behind the end; False when the disk has none left."""
        wanted_end = self.size_bytes + size_bytes
        if not self._can_allocate or wanted_end <= self._allocated_bytes:
            return True
        for step in (ALLOCATION_STEP_BYTES, 0):
            length = size_bytes + step
            if _libc.fallocate(self._fd, FALLOC_FL_KEEP_SIZE, self.size_bytes, length) == 0:
                self._allocated_bytes = self.size_bytes + length
                return True
            if ctypes.get_errno() in _NO_FALLOCATE_ERRNOS:  # an interrupt as well: it is a service, not a must
                self._can_allocate = False  # this file system cannot: a failing write is then taken back
                return True
        return False

    def _write_all(self, data: bytes) -> bool:
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except OSError as error:
            if error.errno in _OWN_ERRNOS:
                raise
            self._cut()
            return False
        return True

    def _cut(self) -> None:
        """Back to the last whole record; what cannot be cut off is written over by the next one, or cut at the end."""
        if os.lseek(self._fd, 0, os.SEEK_CUR) != self.size_bytes:
            os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size_bytes)
            self._allocated_bytes = 0  # truncation freed what was allocated ahead


def _cannot_write(path: Path, why: str) -> LogError:
    return LogError(
        str(path), f"the log cannot be written: {why}", remedy="free disk space, choose another --log, or --no-log"
    )


def _offset_of(index_record: bytes) -> int:
    return struct.unpack_from("<Q", index_record, 9)[0]


def _short_ending(crc: int) -> bytes:
    """The least that makes a file finished: no summary, readers scan."""
    footer = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
    return record_bytes(DataEnd(data_section_crc=crc)) + record_bytes(footer) + MAGIC
