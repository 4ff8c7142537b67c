"""Logs of can-utils: `candump -L` and `-l`, and what candump prints on the screen with -ta, -tA, -tz or -td.

    (1436509052.249713) can0 123#1122 R             -L; FD frames 123##1.., remote frames 123#R4
     (000.001234)  can0  RX - -  123   [8]  11 22 33 44 55 66 77 88   'ascii'

Source: can-utils, lib.c (snprintf_canframe, snprintf_long_canframe) and candump.c.
"""

import datetime
import re

from hilrunner.setup import can_frame
from hilrunner.setup.can_log import CanLog, DamagedLogError, is_last, seconds_ns, shown

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LOGGED = re.compile(r"\(([^)]*)\)\s+(\S+)\s+([0-9A-Fa-f]+)#(\S*)(?:\s+[RTrt])?")
_SHOWN = re.compile(r"(?:\(([^)]*)\)\s+)?(\S+)\s+(?:(?:RX|TX)\s+\S+\s+\S+\s+)?([0-9A-Fa-f]{3,8})\s+\[(\d+)\](.*)")
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?")
_LOG_FORM = "(seconds) channel id#data, as `candump -L` writes it"
_RECORD = "record with `candump -L`"
_UNIX_NS = 10**9 * 10**8  # stamps above 3 years count from 1970, not from the start of the recording


def read(text: str) -> CanLog:
    """Every frame; a last line that was cut is left out and told. DamagedLogError names the line of any other fault."""
    log = CanLog("candump")
    lines = text.split("\n")
    screen = False
    for index, line in enumerate(lines):
        line = (_COLOUR.sub("", line) if "\x1b" in line else line).strip()
        if not line or line.startswith("#"):
            continue
        try:
            screen |= _read_line(log, line)
        except ValueError as error:
            if is_last(lines, index) and log.time_ns:
                log.cut = f"its last line is cut: {shown(line)}"
                break
            limit, remedy = (
                (_LOG_FORM, _RECORD)
                if not log.time_ns or "time stamp" in str(error)
                else (_LOG_FORM, "mend or remove the line")
            )
            raise DamagedLogError(
                f"line {index + 1}", f"{shown(line)} is not a frame: {error}", limit, remedy
            ) from None
    if screen:
        _resolve_differences(log)
    return log


def _read_line(log: CanLog, line: str) -> bool:
    """Append one frame; True where it is in the form of the screen. ValueError says what is wrong."""
    logged = _LOGGED.fullmatch(line)
    if logged:
        stamp, channel, digits, data = logged.groups()
        log.append(_time_ns(stamp), channel, _logged_packet(digits, data))
        return False
    on_screen = _SHOWN.fullmatch(line)
    if on_screen is None:
        raise ValueError("not a line of candump")
    stamp, channel, digits, length, rest = on_screen.groups()
    if stamp is None:
        raise ValueError("it has no time stamp")
    log.append(_time_ns(stamp), channel, _shown_packet(digits, length, rest))
    return True


def _time_ns(stamp: str) -> int:
    date = _DATE.fullmatch(stamp)
    if date is None:
        return seconds_ns(stamp)
    whole = datetime.datetime(*map(int, date.groups()[:6]), tzinfo=datetime.UTC)
    return int(whole.timestamp()) * 1_000_000_000 + int((date[7] or "0").ljust(9, "0"))


def _can_id(digits: str) -> int:
    can_id = int(digits, 16)
    if len(digits) == 8:
        error = can_id & can_frame.ERR
        return can_id if error else (can_id & 0x1FFFFFFF) | can_frame.EFF
    if len(digits) != 3 or can_id > 0x7FF:
        raise ValueError(f"the identifier {digits} has neither 3 nor 8 digits")
    return can_id


def _logged_packet(digits: str, data: str) -> bytes:
    can_id = _can_id(digits)
    if data.startswith("#"):
        return can_frame.pack_fd(can_id, int(data[1:2], 16) & (can_frame.BRS | can_frame.ESI), _bytes(data[2:], 64))
    if data[:1] in ("R", "r"):
        length = int(data[1:2] or "0", 16)
        return can_frame.pack_classic(can_id | can_frame.RTR, min(length, 8), b"")
    payload = _bytes(data.partition("_")[0], 8)  # behind the underscore: a DLC of 9 to 15 that still means 8 bytes
    return can_frame.pack_classic(can_id, len(payload), payload)


def _shown_packet(digits: str, length: str, rest: str) -> bytes:
    can_id, count = _can_id(digits), int(length)
    rest = rest.partition("'")[0].strip()
    if rest.lower().startswith("remote request"):
        return can_frame.pack_classic(can_id | can_frame.RTR, min(count, 8), b"")
    words = rest.replace("ERRORFRAME", "").split()
    payload = _bytes("".join(words), 64)
    if len(payload) != count or any(len(word) != 2 for word in words):
        raise ValueError(f"{len(words)} of {count} data bytes")
    if len(length) > 1:  # candump pads the length of FD frames
        return can_frame.pack_fd(can_id, 0, payload)
    if count > 8:
        raise ValueError(f"{count} data bytes in a classic frame")
    return can_frame.pack_classic(can_id, count, payload)


def _bytes(digits: str, most: int) -> bytes:
    payload = bytes.fromhex(digits.replace(".", ""))
    if len(payload) > most:
        raise ValueError(f"{len(payload)} data bytes, at most {most}")
    return payload


def _resolve_differences(log: CanLog) -> None:
    """`-td` and `-tz` look alike: both begin with 0. Differences become times; what may be either is refused."""
    stamps = log.time_ns
    if stamps[0] > _UNIX_NS or len(stamps) < 3:
        return
    steps = [after - before for before, after in zip(stamps, stamps[1:], strict=False)]
    if min(steps) > 0:
        log.stamps = "from the start (candump -tz)"
    elif min(steps) < 0:
        total = 0
        for index, step in enumerate(stamps):
            total += step
            log.time_ns[index] = total
        log.stamps = "differences (candump -td)"
    else:
        raise DamagedLogError("", "its time stamps may be times (candump -tz) or differences (-td)", _LOG_FORM, _RECORD)
