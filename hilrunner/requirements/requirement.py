"""One requirement: what a person wrote, where it comes from, and the formula that a run is judged by."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from hilrunner.base.errors import UsageError
from hilrunner.requirements.parse import SignalKind, parse_formula
from hilrunner.requirements.tree import Formula

_SIZE_MAX_BYTES = 4 << 20


class Written(Struct, forbid_unknown_fields=True, frozen=True):
    """A requirement as it stands in a profile or a requirements file."""

    id: Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^\S+$", description="its name, without spaces")]
    formula: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=20_000,
            description="signal temporal logic over logged signals, see docs/requirements.md",
        ),
    ]
    text: Annotated[str, Meta(max_length=4_000, description="what it asks for, in words")] = ""
    source: Annotated[
        str, Meta(max_length=400, description="where it comes from: a standard and its section, a document")
    ] = ""


class _File(Struct, forbid_unknown_fields=True, frozen=True):
    requirement: tuple[Written, ...]


@dataclass(frozen=True)
class Requirement:
    """A requirement with its formula understood."""

    id: str
    text: str
    source: str
    written: str
    formula: Formula


def understand(written: tuple[Written, ...], signals: Mapping[str, SignalKind], place: str) -> list[Requirement]:
    """Parse every formula.

    Raises:
        UsageError: two requirements of one id, or a formula that does not fit the signals; names the id and the position.
    """
    seen: set[str] = set()
    found = []
    for one in written:
        if one.id in seen:
            raise UsageError(f"{place}: requirement {one.id}", "this id is given twice", remedy="give each its own id")
        seen.add(one.id)
        formula = parse_formula(one.formula, signals, f"{place}: requirement {one.id}")
        found.append(Requirement(one.id, one.text, one.source, one.formula, formula))
    return found


def _text(data: bytes) -> str:
    """UTF-8 with or without a mark, else cp1252 as editors on Windows write it."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")


def read_requirements(path: Path) -> tuple[Written, ...]:
    """The requirements of a TOML file: a list of `[[requirement]]`.

    Raises:
        UsageError: not readable, not TOML, or an unknown or missing key.
    """
    try:
        if path.stat().st_size > _SIZE_MAX_BYTES:
            raise UsageError(str(path), f"{path.stat().st_size} bytes", f"at most {_SIZE_MAX_BYTES}", "split the file")
        raw = tomllib.loads(_text(path.read_bytes()))
        return msgspec.convert(raw, _File).requirement
    except OSError as error:
        raise UsageError(str(path), f"cannot be read: {error.strerror}", remedy="name a TOML file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(str(path), f"not TOML: {error}", remedy="mend the syntax at that line") from None
    except msgspec.ValidationError as error:
        raise UsageError(str(path), str(error), "id, formula, text, source", "correct that key") from None
