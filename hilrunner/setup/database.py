"""A database of CAN messages as cantools reads it: DBC, KCD, SYM, ARXML, each file once; its messages by name or identifier.

What other people's editors leave in a file is told, not raised: attributes that are not defined, two messages of one name, texts in
another encoding. A file is refused only where no messages can be had from it.
"""

import logging
import re
from functools import lru_cache
from pathlib import Path

import cantools

from hilrunner.base.errors import DbcError
from hilrunner.setup.text import read_text

MOST_BYTES = 16 << 20  # some 200,000 signals; cantools takes about half a minute for so many
LONGEST_TEXT = 1 << 18  # of a comment, or of what stands between two texts
FORMATS = {".dbc": "dbc", ".kcd": "kcd", ".sym": "sym", ".arxml": "arxml", ".cdd": "cdd"}
# not the bare words of the section NS_
_ATTRIBUTE_NAME = re.compile(r'(?m)^[ \t]*BA_[A-Z_]*[ \t]+(?:(?:BU_|BO_|SG_|EV_)[ \t]+)?"(\w+)"')
_ATTRIBUTES_TRIED, _TRIED_CHARACTERS = 40, 500_000  # each try reads the whole file again
_ATTRIBUTES = re.compile(
    r'(?m)^[ \t]*BA_(?:DEF_DEF_REL_|DEF_REL_|DEF_DEF_|DEF_|REL_)?[ \t]+(?=["\w])(?:[^";]|"(?:[^"\\]|\\.)*")*;'
)


def load_database(path: str | Path) -> cantools.database.Database:
    """The messages of a database file; DbcError where it is missing, no text, or holds no messages that can be had.

    Not strict: a user's file may overlap in messages nobody maps; mapped ones are checked where their rows are made.
    """
    return _kept(Path(path))[0]


def database_notes(path: str | Path) -> tuple[str, ...]:
    """What is odd about a file and was lived with, in words."""
    return _kept(Path(path))[1]


def _kept(path: Path):
    try:
        found = path.stat()
        version = found.st_mtime_ns, found.st_size
    except (OSError, ValueError):
        version = 0, 0  # reading it says what is wrong
    return _parsed(path, version)


@lru_cache(maxsize=8)
def _parsed(path: Path, _version: tuple[int, int]):
    """Set-up asks several times for one file, which costs a tenth of a second each time."""
    kind = FORMATS.get(path.suffix.lower(), "dbc")
    notes: list[str] = []
    # cantools itself would read every byte that is not UTF-8 as a replacement character
    text = read_text(path, DbcError, "name an existing database file", MOST_BYTES)
    if kind in ("dbc", "sym"):
        _check_texts(path, text)
    try:
        database = _load(text, kind)
    except Exception as error:  # cantools lets parser and value errors of several modules through
        database = _without_attributes(text, kind, error, notes)
        if database is None:
            raise DbcError(
                str(path),
                f"is not a {kind.upper()} file cantools understands ({_short(error)})",
                remedy="export it again",
            ) from error
    if not isinstance(database, cantools.database.Database):
        raise DbcError(
            str(path),
            "describes diagnostics, no CAN messages",
            "DBC, KCD, SYM or ARXML",
            "name the network's own database",
        )
    return database, tuple(notes + _same_names(database))


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


def _load(text: str, kind: str):
    logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of is in the notes
    return cantools.database.load_string(text, kind, strict=False)


def _short(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) < 300 else f"{text[:300]} …"


def _without_attributes(text: str, kind: str, error: Exception, notes: list[str]):
    """A DBC that cannot be read with all its attributes, read without the one that stands in the way, else without any.

    None where attributes are not the reason.
    """
    if kind != "dbc":
        return None
    names = list(dict.fromkeys(_ATTRIBUTE_NAME.findall(text)))[:_ATTRIBUTES_TRIED]
    for name in [*(names if len(text) <= _TRIED_CHARACTERS else []), None]:
        kept = _ATTRIBUTES.sub(lambda one, name=name: "" if name in (None, _name_in(one[0])) else one[0], text)
        if kept == text:
            continue
        try:
            database = _load(kept, kind)
        except Exception:
            continue
        what = "its attributes" if name is None else f"its attribute '{name}'"
        notes.append(
            f"{what} cannot be read ({_short(error)}), so what {'they tell' if name is None else 'it tells'} of cycle times, start values "
            "or protection is unknown; give it in the mapping"
        )
        return database
    return None


def _name_in(statement: str) -> str:
    found = _ATTRIBUTE_NAME.search(statement)
    return found[1] if found else ""


def _same_names(database) -> list[str]:
    """Messages that share a name, which by itself then means none of them."""
    by_name: dict[str, list[int]] = {}
    for message in database.messages:
        by_name.setdefault(message.name, []).append(message.frame_id)
    return [
        f"{len(ids)} messages are called {name} ({', '.join(hex(one) for one in ids)}): they can be mapped by identifier, "
        f'message = "{hex(ids[0])}"'
        for name, ids in by_name.items()
        if len(ids) > 1
    ]


def find_message(place: str, database, name: str):
    """The cantools message of that name, or of that identifier (`0x18fe3021`); DbcError with the names there are."""
    named = [message for message in database.messages if message.name == name]
    if len(named) == 1:
        return named[0]
    if named:
        ids = ", ".join(f"0x{message.frame_id:x}" for message in named[:8])
        raise DbcError(
            f"{place}: {name}", f"{len(named)} messages have this name (identifiers {ids})", "one",
            f'map it by its identifier, message = "0x{named[0].frame_id:x}"',
        )  # fmt: skip
    number = int(name, 16) if re.fullmatch(r"0[xX][0-9a-fA-F]{1,8}", name) else None
    for message in database.messages:
        if number is not None and message.frame_id == number:
            return message
    known = ", ".join(sorted(message.name for message in database.messages)[:12])
    raise DbcError(
        f"{place}: {name}", "no such message", f"{known}, ..." if known else "the file holds no message",
        "map an existing message, or add axes with firmware_iface/make_axes.py",
    )  # fmt: skip
