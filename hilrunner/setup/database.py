"""A database of CAN messages as cantools reads it, each file once, and its messages found by name."""

from functools import lru_cache
from pathlib import Path

import cantools

from hilrunner.base.errors import DbcError


def load_database(path: Path) -> cantools.database.Database:
    """The messages of a DBC file; DbcError where it cannot be read.

    Not strict: a user's DBC may overlap in messages nobody maps; mapped ones are checked where their rows are made.
    """
    try:
        found = path.stat()
    except OSError as error:
        raise _unreadable(path, error) from error
    return _parsed(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=8)
def _parsed(path: Path, _mtime_ns: int, _size: int) -> cantools.database.Database:
    """Set-up asks several times for one file, which costs a tenth of a second each time."""
    try:
        database = cantools.database.load_file(path, database_format="dbc", encoding="utf-8", strict=False)
    except UnicodeDecodeError:
        database = cantools.database.load_file(path, database_format="dbc", encoding="cp1252", strict=False)
    except OSError as error:
        raise _unreadable(path, error) from error
    except Exception as error:  # cantools lets parser and value errors of several modules through
        raise DbcError(str(path), f"is not a DBC file cantools understands ({error})") from error
    return database


def _unreadable(path: Path, error: OSError) -> DbcError:
    return DbcError(str(path), f"cannot be read ({error.strerror})", remedy="name an existing DBC file")


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
