"""What stands in a log that has just been begun, read back from the file itself before the first tick.

A replay has nothing but the log. A disk that takes bytes and gives others back is noticed here, when nothing is lost yet.
"""

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from hilrunner.base.errors import LogError


def check_attachments(path: Path, attachments: Sequence[tuple[str, str, bytes]]) -> None:
    """LogError unless the file holds exactly these (name, media type, data), in this order; its chunks are not read."""
    from mcap.exceptions import McapError
    from mcap.records import Attachment
    from mcap.stream_reader import StreamReader

    wanted = list(attachments)
    try:
        with open(path, "rb") as file:
            reader = StreamReader(
                file,
                skip_magic=False,
                emit_chunks=True,
                validate_crcs=True,
                record_size_limit=os.fstat(
                    file.fileno()
                ).st_size,  # a length that was spoilt must not ask for more memory than that
            )
            for record in reader.records:
                if isinstance(record, Attachment):
                    name, media_type, data = wanted.pop(0)
                    if (record.name, record.media_type, record.data) != (name, media_type, data):
                        raise _refused(path, name)
                if not wanted:
                    return
    except (OSError, McapError, ValueError, LookupError, EOFError, OverflowError, struct.error) as error:
        raise _refused(path, wanted[0][0] if wanted else "its head") from error
    if wanted:
        raise _refused(path, wanted[0][0])


def _refused(path: Path, name: str) -> LogError:
    return LogError(
        str(path),
        f"'{name}' does not read back as it was written, so the run could not be repeated",
        remedy="choose another disk for --log, and test this one",
    )
