"""A recorded CAN log, whatever tool wrote it: frames with exact integer times, their channels, and what was noticed on the way.

The contents choose the reader, the ending only where they do not tell: logs are renamed more often than converted.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

from hilrunner.base.errors import UsageError
from hilrunner.setup.text import Contents, decoded

FORMATS = {
    ".log": "candump",
    ".asc": "Vector ASC",
    ".blf": "Vector BLF",
    ".trc": "PEAK TRC",
    ".mf4": "ASAM MDF 4",
}
FORMAT_LIST = f"{', '.join(FORMATS)}, .csv of python-can or SavvyCAN, each also with .gz"
_LOST_BYTES_MIN = 4  # the last letter of a text in UTF-16 or UTF-32 ends with up to three zeros
_FIRST_BYTES = ((b"LOGG", ".blf"), (b"MDF ", ".mf4"), (b"UnFinMF ", ".mf4"))
_FIRST_LINES = (
    (re.compile(r"date\s+\w+\s|base\s+(hex|dec)\b", re.IGNORECASE), ".asc"),
    (re.compile(r";\s*\$?FILEVERSION", re.IGNORECASE), ".trc"),
    (re.compile(r"\s*\(\d[^)]*\)\s+\S+\s+(\S+\s+)*[0-9A-Fa-f]+(#|\s+\[\d)"), ".log"),
    (re.compile(r"\s*\S+\s+[0-9A-Fa-f]{3,8}\s+\[\d+\]"), ".log"),
)


@dataclass
class CanLog:
    """Frames in the order of the file; the three lists have one entry a frame."""

    form: str  # which tool's format
    time_ns: list[int] = field(default_factory=list)  # from any start, never rounded beyond what the file tells
    channel: list[str] = field(default_factory=list)  # as the tool names it
    packet: list[bytes] = field(default_factory=list)  # struct can_frame or canfd_frame
    stamps: str = "absolute"  # how the file gives times
    other_lines: int = 0  # lines or objects of other things than frames
    cut: str = ""  # what is missing at the end; empty: the log is whole

    def append(self, time_ns: int, channel: str, packet: bytes) -> None:
        """One more frame."""
        self.time_ns.append(time_ns)
        self.channel.append(channel)
        self.packet.append(packet)


class DamagedLogError(Exception):
    """A row of a log that cannot be read, with where it is and what may help."""

    def __init__(self, where: str, problem: str, limit: str = "", remedy: str = "mend the row or record again") -> None:
        super().__init__(problem)
        self.where, self.problem, self.limit, self.remedy = where, problem, limit, remedy


def kind_of_log(path: Path, contents: Contents) -> str:
    """Ending of the format a file is in, `.csv` for a table of frames; empty for anything else, such as a schedule."""
    from hilrunner.setup.can_log_table import is_frame_table

    for magic, kind in _FIRST_BYTES:
        if contents.data.startswith(magic):
            return kind
    ending = _ending(path)
    if ending == ".toml":
        return ""
    first = _first_line(contents.data)
    for pattern, kind in _FIRST_LINES:
        if pattern.match(first):
            return kind
    if is_frame_table(first):
        return ".csv"
    return ending if ending in FORMATS else ""


def read_can_log(path: Path, kind: str, contents: Contents) -> CanLog:
    """Every frame of a log.

    Args:
        kind: what `kind_of_log` says.

    Raises:
        UsageError: not this format, damaged anywhere but at its end, or without a frame.
    """
    try:
        log = _read(path, kind, contents)
    except DamagedLogError as damage:
        place = f"{path}: {damage.where}" if damage.where else str(path)
        raise UsageError(place, damage.problem, damage.limit, damage.remedy) from None
    except Exception as error:  # python-can's readers fail in ways of their own on damaged and foreign files
        raise UsageError(
            str(path),
            f"cannot be read as {FORMATS.get(kind, kind)}: {error or type(error).__name__}",
            FORMAT_LIST,
            "record it again, or convert it with the tool that wrote it",
        ) from error
    log.cut = contents.cut or log.cut
    if not log.time_ns:
        told = f"; {log.cut}" if log.cut else ""
        raise UsageError(
            str(path), f"holds no frames ({log.form}{told})", FORMAT_LIST, "name a log with valve commands"
        )
    return log


def _read(path: Path, kind: str, contents: Contents) -> CanLog:
    from hilrunner.setup import can_log_blf, can_log_candump, can_log_library, can_log_table

    if kind == ".blf":
        return can_log_blf.read(contents.data)
    if kind == ".mf4":
        return can_log_library.read_mf4(contents.data)
    whole = contents.data.rstrip(b"\0")
    lost_bytes = len(contents.data) - len(whole)  # a file system that lost power leaves zeros where the last lines were
    if lost_bytes < _LOST_BYTES_MIN:
        whole, lost_bytes = contents.data, 0
    try:
        text = decoded(whole)
    except ValueError as error:
        raise DamagedLogError("", f"cannot be read as {FORMATS.get(kind, kind)}: {error}", FORMAT_LIST) from None
    reader = {
        ".log": can_log_candump.read,
        ".csv": can_log_table.read,
        ".asc": can_log_library.read_asc,
        ".trc": can_log_library.read_trc,
    }[kind]
    log = reader(text)
    if lost_bytes:
        log.cut = log.cut or f"its last {lost_bytes} bytes are zeros"
    return log


def is_last(lines: list[str], index: int) -> bool:
    """Whether a line is the last of a text that does not end with a line end: a recorder was stopped while it wrote."""
    return index == len(lines) - 1


def seconds_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly; digits beyond the ninth are dropped. ValueError."""
    whole, _, part = text.strip().partition(".")
    if not whole.isdecimal() or (part and not part.isdecimal()):
        raise ValueError(f"'{text}' is not a number of seconds")
    return int(whole) * 1_000_000_000 + int(part[:9].ljust(9, "0"))


def whole_microseconds(stamps_s: list[float]) -> list[int]:
    """Times from the first frame, ns, in whole microseconds.

    Of formats whose stamps come as float64 of Unix seconds, in the file or from its writer: those are true to a quarter of a
    microsecond, and cut instead of rounded half of a grid's frames would fall into the period before.
    """
    return [round((stamp_s - stamps_s[0]) * 1e6) * 1000 for stamp_s in stamps_s]


def shown(line: str) -> str:
    """A line as an error message shows it."""
    line = line.strip()
    return repr(line if len(line) <= 80 else line[:80] + "…")


def _ending(path: Path) -> str:
    endings = [one.lower() for one in path.suffixes]
    if endings and endings[-1] == ".gz":
        endings.pop()
    return endings[-1] if endings else ""


def _first_line(data: bytes) -> str:
    """The first line that says something."""
    try:
        head = decoded(data[:65536])
    except ValueError:
        return ""
    return next((line for line in head.split("\n") if line.strip() and not line.startswith("#")), "")
