"""The CAN frames of a log as engineering values, and as files that other tools read."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cantools
import numpy as np

from hilrunner.base import records, status
from hilrunner.base.errors import LogError, UsageError
from hilrunner.base.units import NS_PER_S
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.rebuild import sealed_profile
from hilrunner.setup.contract import dbc_path
from hilrunner.setup.database import load_database

_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_ID_MASK = (1 << 29) - 1
_FD, _BIT_RATE_SWITCH = 1, 2
CHANNEL = "bench"  # what the written files call the bus
FORMATS = ("candump", "asc")


@dataclass(frozen=True)
class Selection:
    """Which frames of a log: times since tick 0 in s, message names (none: all), received or sent ones."""

    first_s: float = 0.0
    last_s: float = np.inf
    messages: tuple[str, ...] = ()
    received: bool = True
    sent: bool = True


@dataclass(frozen=True)
class Frame:
    """One frame: seconds since tick 0 and since 1970, and what the database says of it."""

    time_s: float
    real_s: float
    is_sent: bool
    can_id: int
    is_extended: bool
    is_remote: bool
    is_error: bool
    flags: int
    data: bytes
    status: str
    message: str | None  # None: not of the database
    values: dict[str, str]  # signal -> value with its unit

    def line(self) -> str:
        """For a person."""
        name = self.message or "?"
        told = "  ".join(f"{key}={value}" for key, value in self.values.items())
        outcome = "sent" if self.is_sent else self.status
        digits = 8 if self.is_extended else 3
        return f"{self.time_s:12.6f}  {outcome:<14} 0x{self.can_id:0{digits}X}  {name:<20} {told or self.data.hex(' ').upper()}"

    def as_dict(self) -> dict:
        """For a script."""
        return {
            "time_s": self.time_s,
            "real_s": self.real_s,
            "sent": self.is_sent,
            "id": self.can_id,
            "extended": self.is_extended,
            "data": self.data.hex(),
            "status": None if self.is_sent else self.status,
            "message": self.message,
            "values": self.values,
        }


class FrameLog:
    """The frames of one log, in order of time, read once.

    Args:
        path: the log. database_path: in place of the database in the log.

    Raises:
        LogError: not a log of ours, or one without frames. DbcError: the database cannot be read.
    """

    def __init__(self, path: Path, selection: Selection, database_path: Path | None = None) -> None:
        run = read_run(path, {"/can/*": None})
        if not len(run.can_rx) and not len(run.can_tx):
            raise LogError(
                str(path), "holds no CAN frames", "a log of a run on a bus", "a stimulus or a simulation has no bus"
            )
        self.database = load_database(database_path if database_path is not None else dbc_path(sealed_profile(run)))
        known = {message.name: message for message in self.database.messages}
        missing = [name for name in selection.messages if name not in known]
        if missing:
            raise UsageError(
                "--message", f"no message '{missing[0]}'", ", ".join(sorted(known)[:20]), "correct the name"
            )
        self._by_id = {(one.frame_id, bool(one.is_extended_frame)): one for one in reversed(self.database.messages)}
        table = run.metadata.get("run", {})
        self._start_ns = _number(table.get("start_mono_ns"))
        self._offset_ns = _number(table.get("clock_offset_ns"))
        self._rows = self._selected(run, selection)

    def _selected(self, run, selection: Selection) -> np.ndarray:
        parts = []
        for rows, is_sent, wanted in ((run.can_rx, False, selection.received), (run.can_tx, True, selection.sent)):
            if not wanted or not len(rows):
                continue
            part = np.zeros(len(rows), [("mono_ns", "i8"), ("sent", "?"), ("row", rows.dtype)])
            part["mono_ns"], part["sent"], part["row"] = rows["mono_ns"], is_sent, rows
            parts.append(part)
        if not parts:
            return np.zeros(0, [("mono_ns", "i8"), ("sent", "?"), ("row", records.CAN_FRAME)])
        merged = np.concatenate(parts)
        if not self._start_ns:
            self._start_ns = int(merged["mono_ns"].min())
        time_s = (merged["mono_ns"] - self._start_ns) / NS_PER_S
        keep = (time_s >= selection.first_s) & (time_s <= selection.last_s)
        if selection.messages:
            ids = {key for key, one in self._by_id.items() if one.name in selection.messages}
            numbers = np.array([number | (_EXTENDED if extended else 0) for number, extended in ids], np.uint32)
            keep &= np.isin(merged["row"]["can_id"] & np.uint32(_EXTENDED | _ID_MASK), numbers)
        merged = merged[keep]
        return merged[np.argsort(merged["mono_ns"], kind="stable")]

    def __len__(self) -> int:
        return len(self._rows)

    def frames(self) -> Iterator[Frame]:
        """Every selected frame."""
        for row in self._rows:
            yield self._frame(row["row"], bool(row["sent"]))

    def _frame(self, row: np.void, is_sent: bool) -> Frame:
        identifier = int(row["can_id"])
        number, extended = identifier & _ID_MASK, bool(identifier & _EXTENDED)
        data = bytes(row["data"][: int(row["length"])])
        plain = not identifier & (_REMOTE | _ERROR)
        message = self._by_id.get((number, extended)) if plain else None
        real_ns = int(row["kernel_real_ns"]) or int(row["mono_ns"]) + self._offset_ns
        code = int(row["status"])
        return Frame(
            time_s=(int(row["mono_ns"]) - self._start_ns) / NS_PER_S,
            real_s=real_ns / NS_PER_S,
            is_sent=is_sent,
            can_id=number,
            is_extended=extended,
            is_remote=bool(identifier & _REMOTE),
            is_error=bool(identifier & _ERROR),
            flags=int(row["flags"]) & (_FD | _BIT_RATE_SWITCH),
            data=data,
            status=status.FRAME_STATUS_NAMES[code] if code < status.FRAME_STATUS_COUNT else "unknown status",
            message=None if message is None else message.name,
            values={} if message is None else _values(message, data),
        )


def _values(message, data: bytes) -> dict[str, str]:
    """Signal -> value with its unit; empty for data the database cannot read."""
    try:
        decoded = message.decode(data, decode_choices=True, allow_truncated=True)
    except (cantools.Error, ValueError, KeyError):
        return {}
    units = {signal.name: signal.unit or "" for signal in message.signals}
    return {name: _value(value, units.get(name, "")) for name, value in decoded.items()}


def _value(value, unit: str) -> str:
    if hasattr(value, "name"):
        return str(value)
    return f"{value:.10g} {unit}".rstrip()


def _number(text) -> int:
    try:
        return int(text)
    except (TypeError, ValueError):
        return 0


def as_file(frames: Iterator[Frame], kind: str) -> str:
    """The frames as the text of a candump -L or Vector ASC file, written by python-can."""
    import can

    class _Kept(io.StringIO):
        """A file whose text can be had after the writer has closed it."""

        def close(self) -> None:
            self.text = self.getvalue()
            super().close()

    file = _Kept()
    writer = {"candump": can.CanutilsLogWriter, "asc": can.ASCWriter}[kind](file)
    for frame in frames:
        writer.on_message_received(
            can.Message(
                timestamp=frame.real_s,
                arbitration_id=frame.can_id,
                is_extended_id=frame.is_extended,
                is_remote_frame=frame.is_remote,
                is_error_frame=frame.is_error,
                is_fd=bool(frame.flags & _FD),
                bitrate_switch=bool(frame.flags & _BIT_RATE_SWITCH),
                is_rx=not frame.is_sent,
                dlc=len(frame.data),
                data=b"" if frame.is_remote else frame.data,
                channel=CHANNEL,
                check=False,
            )
        )
    writer.stop()
    return file.text
