"""A database of CAN messages as cantools reads it, each file once, and its messages found by name."""

from functools import lru_cache
from pathlib import Path

import cantools

from hilrunner.base.errors import DbcError
from hilrunner.setup.text import read_text


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
    text = read_text(path, DbcError, "name an existing DBC file")
    try:
        return cantools.database.load_string(text, database_format="dbc", strict=False)
    except Exception as error:  # cantools lets parser and value errors of several modules through
        raise DbcError(
            str(path), f"is not a DBC file cantools understands ({error})", remedy="export it again"
        ) from error


def find_message(place: str, database, name: str):
    """The cantools message of that name; DbcError with the names there are."""
    for message in database.messages:
        if message.name == name:
            return message
    known = ", ".join(sorted(message.name for message in database.messages)[:12])
    raise DbcError(
        f"{place}: {name}", "no such message", f"{known}, ..." if known else "the DBC holds no message",
        "map an existing message, or add axes with firmware_iface/make_axes.py",
    )  # fmt: skip
