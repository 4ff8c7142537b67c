"""Tables of CAN frames: the CSV of python-can's CSVWriter and that of SavvyCAN (GVRET), with any of the usual delimiters."""

import base64
import binascii

from hilrunner.setup import can_frame, csv_text
from hilrunner.setup.can_log import CanLog, DamagedLogError

_PYTHON_CAN = ["timestamp", "arbitration_id", "extended", "remote", "error", "dlc", "data"]
_SAVVYCAN = ["time stamp", "id", "extended", "dir", "bus", "len"]  # then D1, D2, …
_NS_PER_US = 1000


def is_frame_table(first_line: str) -> bool:
    """Whether a header is that of a table of frames."""
    try:
        return _reader(csv_text.read_table(first_line).header) is not None
    except ValueError:
        return False


def read(text: str) -> CanLog:
    """Every frame; a last row that was cut is left out and told. DamagedLogError names the row of any other fault."""
    try:
        table = csv_text.read_table(text)
    except ValueError as error:
        raise DamagedLogError("", f"is not a table: {error}", remedy="mend the quotes") from None
    header = [name.lower() for name in table.header]
    reader, log = _reader(header), CanLog("CSV of frames")
    if reader is None:
        raise DamagedLogError(f"row {table.header_line}", f"{csv_text.shown(table.header)} is not the header of a table of frames",
                              f"{','.join(_PYTHON_CAN)} or {','.join(_SAVVYCAN)},d1,…", "name the columns so")  # fmt: skip
    log.form = f"CSV of {reader.__doc__}"
    for number, (line, cells) in enumerate(table.rows, start=1):
        try:
            reader(log, header, cells)
        except (ValueError, IndexError, binascii.Error) as error:
            if number == len(table.rows) and not text.endswith("\n") and log.time_ns:
                log.cut = f"its last row is cut: {csv_text.shown(cells)}"
                break
            raise DamagedLogError(f"row {line}", f"{csv_text.shown(cells)} is not a frame: {error}") from None
    return log


def _reader(header: list[str]):
    names = [name.lower() for name in header]
    if names == _PYTHON_CAN:
        return _python_can
    return _savvycan if names[: len(_SAVVYCAN)] == _SAVVYCAN else None


def _python_can(log: CanLog, _header: list[str], cells: list[str]) -> None:
    """python-can"""
    stamp, identifier, extended, remote, error, length, data = cells
    count, payload = int(length), base64.b64decode(data, validate=True)
    can_id = int(identifier, 16) | _flag(extended, can_frame.EFF) | _flag(remote, can_frame.RTR)
    can_id |= _flag(error, can_frame.ERR)
    if not can_id & (can_frame.RTR | can_frame.ERR) and len(payload) != count:
        raise ValueError(f"{len(payload)} of {count} data bytes")
    # the writer prints a float64 of Unix seconds: true to a quarter of a microsecond, the digits behind it are noise
    time_ns = round(csv_text.number(stamp) * 1e6) * _NS_PER_US
    log.append(time_ns, "", _packet(can_id, count, payload))


def _savvycan(log: CanLog, header: list[str], cells: list[str]) -> None:
    """SavvyCAN"""
    stamp, identifier, extended, _, bus, length = cells[: len(_SAVVYCAN)]
    count = int(length)
    words = cells[len(_SAVVYCAN) : len(_SAVVYCAN) + count]
    if len(words) != count or not all(words):
        raise ValueError(f"{len([word for word in words if word])} of {count} data bytes")
    payload = bytes(int(word, 16) for word in words)
    can_id = int(identifier, 16) | _flag(extended, can_frame.EFF)
    log.append(int(stamp) * _NS_PER_US, bus, _packet(can_id, count, payload))


def _flag(cell: str, flag: int) -> int:
    word = cell.lower()
    if word not in ("0", "1", "true", "false"):
        raise ValueError(f"'{cell}' is neither 0 nor 1")
    return flag if word in ("1", "true") else 0


def _packet(can_id: int, count: int, payload: bytes) -> bytes:
    if not 0 <= can_id <= 0xFFFFFFFF or count > 64 or (can_id & 0x1FFFFFFF > 0x7FF and not can_id & can_frame.EFF):
        raise ValueError("the identifier or the length is out of range")
    if count > 8:
        return can_frame.pack_fd(can_id, 0, payload)
    return can_frame.pack_classic(can_id, count, payload)
