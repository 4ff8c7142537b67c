"""The end of an MCAP file: whether it has one, and whether data, summary and footer are what was written.

Behind the data stand DataEnd (CRC-32 over every byte before it), the summary, the footer (where the summary begins, CRC-32 over
summary and footer) and the magic. Each bit of a finished file is under one of these checks, or compared with what must stand there.
"""

import struct
import zlib

from hilrunner.evidence.mcap_window import Window

MAGIC = b"\x89MCAP0\r\n"
_OPCODE_FOOTER = 0x02
_FOOTER = struct.Struct("<BQQQI")  # opcode, content length, summary start, summary offset start, crc
_FOOTER_CONTENT_BYTES = 20
_TAIL_BYTES = _FOOTER.size + len(MAGIC)
_BLOCK_BYTES = 1 << 20


def looks_ended(window: Window) -> bool:
    """Whether the file ends as a finished one does; one damaged byte in footer or magic does not hide it."""
    if window.size < len(MAGIC) + _TAIL_BYTES:
        return False
    tail = window.tail(_TAIL_BYTES)
    return tail.endswith(MAGIC) or _FOOTER.unpack_from(tail)[:2] == (_OPCODE_FOOTER, _FOOTER_CONTENT_BYTES)


def check_ending(contents, window: Window, stored_crc: int, found_crc: int | None, end: int) -> None:
    """Compare data, summary and footer with their checksums.

    Args:
        contents: mcap_scan.Contents, takes the findings.
        stored_crc, found_crc: of the data, as DataEnd says and as read; None: parts were jumped over (told already).
        end: file offset behind DataEnd.
    """
    if found_crc is not None and found_crc != stored_crc and (stored_crc or contents.is_own):
        contents.harm("the data does not match the checksum at its end")
    if not looks_ended(window):
        contents.note("the summary at the end is cut off; the data before it is whole")
        return
    tail = window.tail(_TAIL_BYTES)
    opcode, length, summary_start, offset_start, crc = _FOOTER.unpack_from(tail)
    footer_at = window.size - _TAIL_BYTES
    if tail[_FOOTER.size :] != MAGIC or (opcode, length) != (_OPCODE_FOOTER, _FOOTER_CONTENT_BYTES):
        contents.harm("the end mark of the file is damaged")
        return
    if footer_at < end:
        contents.harm("the footer of the file is damaged")
    elif summary_start == 0:
        if offset_start or crc or footer_at != end:
            contents.harm("the footer of the file is damaged")
    elif summary_start != end or not (offset_start == 0 or end <= offset_start <= footer_at):
        contents.harm("the footer of the file is damaged: it does not say where the summary begins")
    elif (crc or contents.is_own) and _crc_between(window, end, window.size - len(MAGIC) - 4) != crc:
        contents.harm("the summary does not match its checksum")


def _crc_between(window: Window, start: int, stop: int) -> int:
    crc = 0
    for place in range(start, stop, _BLOCK_BYTES):
        crc = zlib.crc32(window.bytes_at(place, min(_BLOCK_BYTES, stop - place)), crc)
    return crc
