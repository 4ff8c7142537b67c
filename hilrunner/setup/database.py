"""A database of CAN messages as cantools reads it, each file once, and its messages found by name."""

import logging
from functools import lru_cache
from pathlib import Path

import cantools

from hilrunner.base.errors import DbcError
from hilrunner.setup.text import read_text

MOST_DBC_BYTES = 16 << 20  # some 200,000 signals; cantools takes about half a minute for so many
LONGEST_TEXT = 1 << 18  # of a comment, or of what stands between two texts
logging.getLogger("cantools").addHandler(logging.NullHandler())  # it warns of messages that nobody maps, on stderr


def load_database(path: str | Path) -> cantools.database.Database:
    """The messages of a DBC file: UTF-8 with or without a mark, else cp1252 as Vector's tools write it.

    Not strict: a user's DBC may overlap in messages nobody maps; mapped ones are checked where their rows are made.

    Raises:
        DbcError: missing, no text, or not a DBC.
    """
    try:
        found = Path(path).stat()
        version = found.st_mtime_ns, found.st_size
    except OSError:
        version = 0, 0  # reading it says what is wrong
    return _parsed(Path(path), version)


@lru_cache(maxsize=8)
def _parsed(path: Path, _version: tuple[int, int]) -> cantools.database.Database:
    """Set-up asks several times for one file, which costs a tenth of a second each time."""
    # cantools itself would read every byte that is not UTF-8 as a replacement character
    text = read_text(path, DbcError, "name an existing DBC file", MOST_DBC_BYTES)
    _check_texts(path, text)
    try:
        return cantools.database.load_string(text, database_format="dbc", strict=False)
    except Exception as error:  # cantools lets parser and value errors of several modules through
        raise DbcError(
            str(path), f"is not a DBC file cantools understands ({error})", remedy="export it again"
        ) from error


def _check_texts(path: Path, text: str) -> None:
    """The parser takes 300 bytes for every character between two quotation marks, so one mark left out costs gigabytes."""
    longest = max(map(len, text.split('"')))
    if longest > LONGEST_TEXT:
        raise DbcError(
            str(path),
            f"{longest} characters without a quotation mark",
            f"{LONGEST_TEXT}",
            'look for a text whose closing " is missing',
        )


def find_message(place: str, database, name: str):
    """The cantools message of that name; DbcError with the names there are."""
    found = [message for message in database.messages if message.name == name]
    if len(found) == 1:
        return found[0]
    if found:
        ids = ", ".join(f"0x{message.frame_id:x}" for message in found[:8])
        raise DbcError(
            f"{place}: {name}",
            f"{len(found)} messages have this name (identifiers {ids})",
            "one",
            "rename the others in the DBC",
        )
    known = ", ".join(sorted(message.name for message in database.messages)[:12])
    raise DbcError(
        f"{place}: {name}", "no such message", f"{known}, ..." if known else "the DBC holds no message",
        "map an existing message, or add axes with firmware_iface/make_axes.py",
    )  # fmt: skip
