"""Files as other people's tools write them: which encoding a text has, which line ends, whether it is packed, whether it is whole.

Everything that reads a text of a user (profile, schedule, DBC, CAN log, table) reads it here.
"""

import codecs
import os
import stat
import zlib
from dataclasses import dataclass
from pathlib import Path

from hilrunner.base.errors import HilrunnerError

MOST_BYTES = 2 << 30  # of a file once unpacked: a day of CAN at full load as text; more is no input but a mistake
_GZIP_MAGIC = b"\x1f\x8b"
_ZIP_MAGIC = b"PK\x03\x04"
_GZIP_WINDOW = 16 + zlib.MAX_WBITS  # zlib: expect a gzip header
_STEP_BYTES = 16 << 20
# UTF-32's mark begins with that of UTF-16, so it is looked for first
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


@dataclass(frozen=True)
class Contents:
    """The bytes of a file, unpacked where it was packed with gzip, and what is missing of it (empty: it is whole)."""

    data: bytes
    cut: str = ""


def read_contents(
    path: Path, error: type[HilrunnerError], remedy: str = "name a file that can be read", most_bytes: int = MOST_BYTES
) -> Contents:
    """The bytes of a regular file.

    Args:
        error: raised when the file is missing, a folder, a pipe or device (those may never end), not readable or too large.
        remedy: what the error advises.
    """
    try:
        with open(_regular(path, error, remedy), "rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as refused:
        raise error(str(path), f"cannot be read: {refused.strerror or refused}", remedy=remedy) from None
    return unpacked(path, data, error, most_bytes)


def unpacked(path: Path, data: bytes, error: type[HilrunnerError], most_bytes: int = MOST_BYTES) -> Contents:
    """Bytes that were read elsewhere, as `read_contents` gives them; `path` is named in errors."""
    if data.startswith(_GZIP_MAGIC):
        return _gunzipped(path, data, error, most_bytes)
    if len(data) > most_bytes:
        raise _too_large(path, error, most_bytes)
    return Contents(data)


def read_text(
    path: Path, error: type[HilrunnerError], remedy: str = "name a file that can be read", most_bytes: int = MOST_BYTES
) -> str:
    """The text of a file with `\\n` at the end of every line and no byte order mark; `error` where it has none, or too much."""
    contents = read_contents(path, error, remedy, most_bytes)
    if contents.cut:
        raise error(str(path), contents.cut, remedy="copy the file again")
    try:
        return decoded(contents.data)
    except ValueError as refused:
        raise error(str(path), f"cannot be read: {refused}", remedy="save it as UTF-8 text") from None


def decoded(data: bytes) -> str:
    """Text of bytes: by its mark (UTF-8, UTF-16 as PowerShell redirects, UTF-32), else UTF-8, else cp1252 as Windows tools write.

    Raises:
        ValueError: not a text; says why.
    """
    if data.startswith(_ZIP_MAGIC):
        raise ValueError("it is a spreadsheet or a zip archive, not a text: export it as CSV, or unpack it")
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return _lines_ended(_strict(data[len(mark) :], encoding))
    if b"\0" in data:
        return _lines_ended(_strict(data, _unmarked_utf16(data)))
    try:
        return _lines_ended(data.decode("utf-8"))
    except UnicodeDecodeError:
        return _lines_ended(_strict(data, "cp1252"))


def _strict(data: bytes, encoding: str) -> str:
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as refused:
        where = f"byte {refused.start} (0x{data[refused.start]:02x})"
        if encoding == "cp1252":
            raise ValueError(f"it is not a text: {where} is neither UTF-8 nor cp1252") from None
        raise ValueError(f"it begins as {encoding.upper()}, but {where} is not") from None


def _unmarked_utf16(data: bytes) -> str:
    """Which UTF-16 a text without a mark is: plain letters have a zero byte on one side, always the same; ValueError if none."""
    odd, even = data[1:4096:2], data[0:4096:2]
    for low, high, encoding in ((even, odd, "utf-16-le"), (odd, even, "utf-16-be")):
        if high.count(0) > 0.9 * len(high) and not low.count(0):
            return encoding
    raise ValueError("it is not a text: it holds zero bytes")


def _lines_ended(text: str) -> str:
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _regular(path: Path, error: type[HilrunnerError], remedy: str) -> Path:
    """The path if a plain file is there: opening a pipe waits for its writer, and a device has no end."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise error(str(path), "no such file", remedy=remedy) from None
    except (OSError, ValueError) as refused:
        raise error(str(path), f"cannot be read: {getattr(refused, 'strerror', refused)}", remedy=remedy) from None
    if stat.S_ISDIR(mode):
        raise error(str(path), "is a folder", remedy=remedy)
    if not stat.S_ISREG(mode):
        raise error(str(path), "is a pipe or a device, not a file", remedy="write it into a file first")
    return path


def _gunzipped(path: Path, packed: bytes, error: type[HilrunnerError], most_bytes: int) -> Contents:
    """All members of a gzip file, as far as they are there."""
    parts, size_bytes, cut = [], 0, ""
    while packed.startswith(_GZIP_MAGIC):
        member = zlib.decompressobj(_GZIP_WINDOW)
        while packed and not member.eof:
            try:
                part = member.decompress(packed, _STEP_BYTES)
            except zlib.error:
                raise error(str(path), "the gzip file is damaged", remedy="copy the file again") from None
            packed = member.unconsumed_tail
            parts.append(part)
            size_bytes += len(part)
            if size_bytes > most_bytes:
                raise _too_large(path, error, most_bytes)
        packed = packed or member.unused_data.lstrip(b"\0")
        if not member.eof:
            cut = f"the gzip file is cut: {size_bytes} bytes could be unpacked"
    return Contents(b"".join(parts), cut)


def _too_large(path: Path, error: type[HilrunnerError], most_bytes: int) -> HilrunnerError:
    return error(str(path), "is too large", f"at most {most_bytes >> 20} MiB, unpacked", "keep the part that matters")
