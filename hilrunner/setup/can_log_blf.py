"""Vector BLF: the container structure is walked and checked here, python-can decodes the objects inside.

python-can's reader takes the end of a cut file for its end, and never leaves an object of size 0. Layout: a file header
(signature LOGG, size, …, file size, …, start time), then objects (signature LOBJ, header size and version, object size, type);
objects of type 10 are containers with zlib-compressed bytes that hold the objects of the recording, which may go over the
border of two containers. Source: python-can, can/io/blf.py, after Tobias Lorenz' Vector BLF.
"""

import io
import struct
import zlib

from hilrunner.setup import can_frame
from hilrunner.setup.can_log import CanLog, DamagedLogError, whole_microseconds
from hilrunner.setup.library_words import collected
from hilrunner.setup.text import MOST_BYTES

_FILE_HEADER = struct.Struct("<4sL8BQQLL8H8H")
_OBJECT_HEADER = struct.Struct("<4sHHLL")
_CONTAINER_HEADER = struct.Struct("<H6xL4x")
_FILE_HEADER_BYTES = 144
_FILE_SIZE_FIELD = 10
_CONTAINER = 10
_STORED, _DEFLATED = 0, 2
_AGAIN = "copy the file again, or record anew"


def read(data: bytes) -> CanLog:
    """Every frame of the whole objects of a file; DamagedLogError where its structure is broken before the end."""
    import can

    log = CanLog("Vector BLF")
    stream, log.cut = _recording(data)
    whole_bytes, objects, left = _whole_objects(stream)
    if left and not log.cut:
        log.cut = f"its last object is cut ({left} bytes are left over)"
    with collected("can"):
        for message in can.BLFReader(io.BytesIO(_one_container(data, stream[:whole_bytes]))):
            channel = "" if message.channel is None else str(message.channel + 1)
            log.append(message.timestamp, channel, can_frame.pack_frame(message))
    log.time_ns = whole_microseconds(log.time_ns)
    log.other_lines = objects - len(log.time_ns)
    return log


def _recording(data: bytes) -> tuple[bytes, str]:
    """The bytes inside the containers, and what is missing at the end."""
    if len(data) < _FILE_HEADER.size:
        raise DamagedLogError("", f"is no BLF file: {len(data)} bytes", remedy=_AGAIN)
    header = _FILE_HEADER.unpack_from(data)
    if header[0] != b"LOGG" or not _FILE_HEADER.size <= header[1]:
        raise DamagedLogError("", "is no BLF file: it does not begin with LOGG", remedy="name a BLF file")
    told_bytes, place, parts, size_bytes = header[_FILE_SIZE_FIELD], header[1], [], 0
    cut = f"the file is cut: {len(data)} of {told_bytes} bytes are there" if told_bytes > len(data) else ""
    while place + _OBJECT_HEADER.size <= len(data):
        signature, _, _, object_bytes, kind = _OBJECT_HEADER.unpack_from(data, place)
        if signature != b"LOBJ" or object_bytes < _OBJECT_HEADER.size:
            raise DamagedLogError(f"byte {place}", "no object begins here", remedy=_AGAIN)
        body = data[place + _OBJECT_HEADER.size : place + object_bytes]
        is_cut = place + object_bytes > len(data)
        if kind == _CONTAINER and len(body) >= _CONTAINER_HEADER.size:
            parts.append(_unpacked(body, place, is_cut))
            size_bytes += len(parts[-1])
            if size_bytes > MOST_BYTES:
                raise DamagedLogError(
                    "", "is too large", f"at most {MOST_BYTES >> 30} GiB, unpacked", "cut the part that matters"
                )
        if is_cut:
            cut = cut or f"the file is cut: its last container has {len(data) - place} of {object_bytes} bytes"
            break
        place += object_bytes + object_bytes % 4
    else:
        if data[place:].strip(b"\0"):
            cut = cut or f"the file is cut: {len(data) - place} bytes of an object's header are there"
    return b"".join(parts), cut


def _unpacked(body: bytes, place: int, is_cut: bool) -> bytes:
    method, size_bytes = _CONTAINER_HEADER.unpack_from(body)
    packed = body[_CONTAINER_HEADER.size :]
    if method == _STORED:
        return packed
    if method != _DEFLATED:
        raise DamagedLogError(f"byte {place}", f"a container is packed by method {method}", "0 or 2", _AGAIN)
    member = zlib.decompressobj()
    try:
        unpacked = member.decompress(packed, MOST_BYTES)
    except zlib.error:
        raise DamagedLogError(f"byte {place}", "a container is damaged", remedy=_AGAIN) from None
    if not is_cut and (not member.eof or (size_bytes and len(unpacked) != size_bytes)):
        raise DamagedLogError(
            f"byte {place}", f"a container holds {len(unpacked)} of {size_bytes} bytes", remedy=_AGAIN
        )
    return unpacked


def _whole_objects(stream: bytes) -> tuple[int, int, int]:
    """Up to where the stream holds whole objects, how many, and how many bytes lie behind them."""
    place, count = 0, 0
    while True:
        begin = stream.find(b"LOBJ", place, place + 8)
        if begin < 0:
            left = len(stream) - place
            if left >= 8:
                raise DamagedLogError(f"byte {place} of the recording", "no object begins here", remedy=_AGAIN)
            return place, count, left if stream[place:].strip(b"\0") else 0
        if begin + _OBJECT_HEADER.size > len(stream):
            return place, count, len(stream) - begin
        _, header_bytes, version, object_bytes, _ = _OBJECT_HEADER.unpack_from(stream, begin)
        if object_bytes < _OBJECT_HEADER.size or header_bytes > object_bytes:
            raise DamagedLogError(f"byte {begin} of the recording", f"an object of {object_bytes} bytes", remedy=_AGAIN)
        if begin + object_bytes > len(stream):
            return place, count, len(stream) - begin
        place, count = begin + object_bytes, count + (version in (1, 2))


def _one_container(data: bytes, stream: bytes) -> bytes:
    """A BLF file in memory with the same recording in one stored container, and with time counted from its start."""
    header = list(_FILE_HEADER.unpack_from(data))
    header[1] = _FILE_HEADER_BYTES
    header[14:30] = [0] * 16  # no start, no end
    container = _OBJECT_HEADER.pack(
        b"LOBJ", 16, 1, _OBJECT_HEADER.size + _CONTAINER_HEADER.size + len(stream), _CONTAINER
    )
    body = _CONTAINER_HEADER.pack(_STORED, len(stream)) + stream
    return _FILE_HEADER.pack(*header).ljust(_FILE_HEADER_BYTES, b"\0") + container + body
