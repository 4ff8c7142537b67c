"""What reading a log may cost, in memory and in work, measured against the size of its file.

A log comes from anywhere. Everything a bench writes stays far below these numbers (a chunk of ours unpacks to some four
times its bytes, docs/log.md); a file that asks for more was made to fill the memory of whoever opens it, and is refused
with one sentence before it does.
"""

from hilrunner.base.errors import LogError

MIB = 1 << 20
RECORD_BYTES_MAX = 256 * MIB  # one record of the file: a chunk, an attachment
CHUNK_BYTES_MAX = 128 * MIB  # one chunk, unpacked; the largest of ours, of 32 axes after a held-up recorder: 30 MB
UNPACKED_RATIO, UNPACKED_BYTES_MIN = 200, 256 * MIB  # all chunks together
KEPT_RATIO, KEPT_BYTES_MIN = 64, 192 * MIB  # rows that stay in memory
ATTACHED_BYTES_MAX, ATTACHMENTS_MAX = 256 * MIB, 1000
DESCRIBED_BYTES_MAX = 32 * MIB  # metadata, schemas, channels: texts about the data
RECORDS_MIN, BYTES_PER_RECORD = 500_000, 64  # records that are no messages: each is looked at by itself
DAMAGED_PLACES_MAX = 1000  # after so many, a file is rubble and no log
OWN_CHANNELS_MAX = 1024
AXES_MAX = 64  # a profile has at most 32
SKIPPED_PERIODS_MAX = 1 << 24  # of a whole run: at 1 kHz, four and a half hours in which nothing ran
SKIPPED_REPLAYED_MAX = 1 << 22  # of a run that is replayed: these are computed

_REMEDY = "no bench writes this; ask where the file comes from"


class Budget:
    """Counts what one file has cost so far; every method raises LogError when that is too much.

    Args:
        place: the file, for the error. file_size_bytes: what the limits are measured against.
    """

    def __init__(self, place: str, file_size_bytes: int) -> None:
        self._place = place
        self._size = file_size_bytes
        self._unpacked = 0
        self._kept = 0
        self._attached = 0
        self._attachments = 0
        self._described = 0
        self._records = 0

    def unpack(self, size: int) -> None:
        """A chunk gives `size` bytes."""
        self._unpacked += size
        self._check("its chunks unpack to", self._unpacked, UNPACKED_RATIO, UNPACKED_BYTES_MIN)

    def keep(self, size: int) -> None:
        """Rows of `size` bytes more stay in memory."""
        self._kept += size
        self._check("its messages take", self._kept, KEPT_RATIO, KEPT_BYTES_MIN)

    @property
    def keepable_bytes(self) -> int:
        """What `keep` would still grant."""
        return max(KEPT_BYTES_MIN, KEPT_RATIO * self._size) - self._kept

    def attach(self, size: int) -> None:
        """An attachment of `size` bytes."""
        self._attached += size
        self._attachments += 1
        if self._attached > ATTACHED_BYTES_MAX:
            raise LogError(
                self._place,
                f"its attachments take more than {self._attached / 1e6:.0f} MB",
                f"{ATTACHED_BYTES_MAX / 1e6:.0f} MB in all",
                _REMEDY,
            )
        if self._attachments > ATTACHMENTS_MAX:
            raise LogError(self._place, f"more than {ATTACHMENTS_MAX} attachments", str(ATTACHMENTS_MAX), _REMEDY)

    def describe(self, size: int) -> None:
        """A table of metadata, a schema or a channel of `size` bytes."""
        self._described += size
        if self._described > DESCRIBED_BYTES_MAX:
            raise LogError(
                self._place,
                f"its metadata, schemas and channels take more than {DESCRIBED_BYTES_MAX / 1e6:.0f} MB",
                f"{DESCRIBED_BYTES_MAX / 1e6:.0f} MB in all",
                _REMEDY,
            )

    def look_at(self) -> None:
        """One record that is no message."""
        self._records += 1
        allowed = RECORDS_MIN + self._size // BYTES_PER_RECORD
        if self._records > allowed:
            raise LogError(
                self._place,
                f"more than {allowed} records that are no messages",
                f"{RECORDS_MIN}, and one more for every {BYTES_PER_RECORD} bytes of the file",
                _REMEDY,
            )

    def _check(self, what: str, size: int, ratio: int, least: int) -> None:
        if size > max(least, ratio * self._size):
            raise LogError(
                self._place,
                f"{what} more than {size / 1e6:.0f} MB, and the file has {self._size / 1e6:.3f} MB",
                f"{ratio} times the size of the file, and {least / 1e6:.0f} MB for a small one",
                _REMEDY,
            )
