"""Vector ASC, PEAK TRC and ASAM MDF 4 through python-can's readers, with what those leave out: times that are differences,
exact stamps, the number of a bad line, lines that were dropped, and a last line that was cut.
"""

import importlib.util
import io
import re
from collections.abc import Iterator
from typing import Any

from hilrunner.setup import can_frame
from hilrunner.setup.can_log import CanLog, DamagedLogError, is_last, seconds_ns, shown, whole_microseconds
from hilrunner.setup.library_words import collected

_ASC_BASE = re.compile(r"\s*base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)
_ASC_EVENT = re.compile(r"\s*(\d+(?:[.,]\d+)?)(\s+\S.*)")
_ASC_START = re.compile(r"\s+Start of measurement\s*", re.IGNORECASE)
_ASC_REQUEST = re.compile(r"\s+\d+\s+\S+\s+TxRq\b", re.IGNORECASE)  # asks for a frame that its own Tx line tells again
_ASC_HEADER = ["base {base} timestamps absolute", "internal events logged"]
_TRC_VERSION = re.compile(r";\s*\$FILEVERSION\s*=\s*(\S+)", re.IGNORECASE)
_TRC_VERSIONS = ("1.1", "1.3", "2.0", "2.1")  # python-can takes any other for 1.0 and reads wrong columns


class _Feed(io.TextIOBase):
    """Lines one by one, knowing which was asked for last."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines

    def __next__(self) -> str:
        return next(self._lines)


def read_asc(text: str) -> CanLog:
    """Vector ASC: hexadecimal or decimal, absolute or relative stamps (relative ones count from the line before, of any kind)."""
    import can

    lines = text.split("\n")
    base, relative = _asc_header(lines)
    log = CanLog("Vector ASC", stamps="relative" if relative else "absolute")
    position = _Position()
    position.hexadecimal = base == "hex"
    feed = _Feed(_asc_lines(lines, base, relative, position))
    reader = can.ASCReader(feed, base=base)
    _collect(
        reader,
        log,
        lines,
        position,
        lambda message: str((message.channel or 0) + 1) if message.channel is not None else "",
    )
    log.other_lines = position.events - len(log.time_ns)
    return log


class _Position:
    """Where in the file a reader is: index of the line, its exact time, and how many lines told an event so far."""

    index = -1
    time_ns: int | None = None
    events = 0
    hexadecimal = True
    words: list[str] = []  # what the reader has logged


def _asc_header(lines: list[str]) -> tuple[str, bool]:
    """Number base and whether stamps are differences; without a header the format's defaults."""
    for line in lines:
        found = _ASC_BASE.match(line)
        if found:
            return found[1].lower(), (found[2] or "").lower() == "relative"
        if _ASC_EVENT.fullmatch(line):
            break
    return "hex", False


def _asc_lines(lines: list[str], base: str, relative: bool, position: _Position) -> Iterator[str]:
    """A header that python-can takes whole, then every line, with `position` on it."""
    yield from (line.format(base=base) for line in _ASC_HEADER)
    total_ns = 0
    for index, line in enumerate(lines):
        event = _ASC_EVENT.fullmatch(line)
        position.index = index
        if event is None:
            continue
        stamp_ns = seconds_ns(event[1].replace(",", "."))
        total_ns = total_ns + stamp_ns if relative else stamp_ns
        position.time_ns = total_ns
        position.events += not _ASC_START.fullmatch(event[2])
        if not _ASC_REQUEST.match(event[2]):
            yield f"{total_ns // 10**9}.{total_ns % 10**9:09d}{event[2]}"


def read_trc(text: str) -> CanLog:
    """PEAK TRC 1.0, 1.1, 1.3, 2.0 and 2.1."""
    import can

    version = _TRC_VERSION.search(text[:65536])
    if version and version[1] not in _TRC_VERSIONS:
        raise DamagedLogError("", f"is a PEAK trace of version {version[1]}", f"1.0, {', '.join(_TRC_VERSIONS)}",
                              "convert it with PEAK-Converter, or record in one of these versions")  # fmt: skip
    lines = text.split("\n")
    log, position = CanLog(f"PEAK TRC {version[1] if version else '1.0'}"), _Position()
    if not any(line.strip() and not line.startswith(";") for line in lines):
        return log  # python-can would take the last line of the header for a frame
    _collect(
        can.TRCReader(_Feed(_trc_lines(lines, position))), log, lines, position, lambda message: str(message.channel)
    )
    log.time_ns = whole_microseconds(log.time_ns)
    log.other_lines = position.events - len(log.time_ns)
    return log


def _trc_lines(lines: list[str], position: _Position) -> Iterator[str]:
    for index, line in enumerate(lines):
        position.index = index
        if line.strip():
            position.events += not line.startswith(";")
            yield line
            if position.words:  # python-can has dropped the line and would go on
                raise ValueError(position.words.pop())


def read_mf4(data: bytes) -> CanLog:
    """ASAM MDF 4 with bus logging; needs the package asammdf."""
    import can

    if importlib.util.find_spec("asammdf") is None:
        raise DamagedLogError(
            "",
            "MDF 4 needs the package asammdf, which is not installed",
            remedy="pip install asammdf, or export the log as .asc or .blf",
        )
    reader = can.MF4Reader(io.BytesIO(data))
    log = CanLog("ASAM MDF 4")
    for message in reader:
        log.append(
            message.timestamp,
            str(message.channel if message.channel is not None else ""),
            can_frame.pack_frame(message),
        )
    log.time_ns = whole_microseconds(log.time_ns)
    return log


def _collect(reader: Any, log: CanLog, lines: list[str], position: _Position, channel_of) -> None:
    """Every message of a reader; `position` says which line it comes from."""
    with collected("can") as position.words:
        messages, last = iter(reader), -1
        while True:
            try:
                message = next(messages, None)
                if message is None:
                    log.cut = log.cut or _unread_end(lines, last)
                    return
                last = position.index
                _check_length(message, lines[position.index], position, lines)
            except (ValueError, IndexError, KeyError) as error:
                line = lines[position.index]
                if is_last(lines, position.index) and log.time_ns:
                    log.cut = f"its last line is cut: {shown(line)}"
                    return
                raise DamagedLogError(f"line {position.index + 1}", f"{shown(line)} is not a frame: {error}") from None
            time_ns = message.timestamp if position.time_ns is None else position.time_ns
            log.append(time_ns, channel_of(message), can_frame.pack_frame(message))


def _unread_end(lines: list[str], last: int) -> str:
    """What a last line without a line end may have been when it made no frame; comments and end marks are whole."""
    line = lines[-1].strip()
    if (
        not line
        or last == len(lines) - 1
        or line.startswith(("//", ";"))
        or line.lower().startswith("end triggerblock")
    ):
        return ""
    return f"its last line is cut: {shown(line)}"


def _check_length(message: Any, line: str, position: _Position, lines: list[str]) -> None:
    """A line that ends early makes a frame with fewer bytes than it says, which python-can fills with zeros or not at all."""
    if message.is_remote_frame or message.is_error_frame:
        return
    if len(message.data) != message.dlc:
        raise ValueError(f"{len(message.data)} of {message.dlc} data bytes")
    words = line.split()[-message.dlc :] if message.dlc else []
    one_digit = bool(words) and len(words[-1]) == 1 and position.hexadecimal
    if is_last(lines, position.index) and one_digit and _bytes_of(words) == list(message.data):
        raise ValueError("its last data byte has one digit")


def _bytes_of(words: list[str]) -> list[int]:
    try:
        return [int(word, 16) for word in words]
    except ValueError:
        return []  # not the data: more is told behind it
