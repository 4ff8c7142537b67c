"""What is wrong with a profile, in the words of its author: msgspec's message becomes place, value, limit and remedy."""

import difflib
import re
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from msgspec import Struct

from hilrunner.base.errors import ProfileError

_SHOWN = 80  # characters of a value that an error repeats


def explain(struct: Any, place: str, raw: dict, message: str) -> ProfileError:
    """Turn msgspec's message into place, value, limit and remedy."""
    match = re.search(r" - at `\$(?P<path>.*)`$", message)
    path = (match["path"] if match else "").lstrip(".")
    problem = message[: match.start()] if match else message
    unknown = re.search(r"unknown field `(?P<key>[^`]+)`", problem)
    if unknown:
        key = unknown["key"]
        known = _known_keys(struct, path)
        near = difflib.get_close_matches(key, known, n=1)
        remedy = f"did you mean '{near[0]}'?" if near else "remove it or use one of the allowed keys"
        unit_remedy = _unit_remedy(key, known)
        return ProfileError(
            f"{place}: {path or 'top level'}", f"unknown key '{key}'", ", ".join(known), unit_remedy or remedy
        )
    missing = re.search(r"missing required field `(?P<key>[^`]+)`", problem)
    if missing:
        return ProfileError(f"{place}: {path or 'top level'}", f"'{missing['key']}' is missing", remedy="add it")
    value = _value_at(raw, path)
    found = f" but found {_short(value)}" if value is not None and repr(value) not in problem else ""
    allowed = ", ".join(_choices(struct, path)) if problem.startswith("Invalid enum value") else _range(struct, path)
    return ProfileError(f"{place}: {path or 'top level'}", f"{problem}{found}", allowed, remedy="correct the value")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}… ({len(text)} characters)"


def _unit_remedy(key: str, known: list[str]) -> str:
    """A key with the right quantity and a wrong unit deserves to be told so."""
    stem = key.rsplit("_", 1)[0]
    for candidate in known:
        if candidate.rsplit("_", 1)[0] == stem and candidate != key:
            return f"the unit of '{stem}' is fixed: write '{candidate}'"
    return ""


def _choices(root: Any, path: str) -> tuple[str, ...]:
    """The words a key of the format may hold; empty where it is no choice."""
    parent, _, key = re.sub(r"\[[^\]]*\]", "", path).rpartition(".")
    hint = next(
        (f.type for f in msgspec.structs.fields(_struct_at(root, parent) or root) if f.encode_name == key), None
    )
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    return get_args(hint) if get_origin(hint) is Literal else ()


def _known_keys(root: Any, path: str) -> list[str]:
    struct = _struct_at(root, path)
    return [f.encode_name for f in msgspec.structs.fields(struct)] if struct is not None else []


def _struct_at(root: Any, path: str) -> Any:
    names = [part for part in re.sub(r"\[[^\]]*\]", "", path).split(".") if part]
    struct: Any = root
    for name in names:
        hint = next((f.type for f in msgspec.structs.fields(struct) if f.encode_name == name), None)
        struct = _struct_in(hint)
        if struct is None:
            return None
    return struct


def _struct_in(hint: Any) -> Any:
    if isinstance(hint, type) and issubclass(hint, Struct):
        return hint
    for inner in get_args(hint):
        found = _struct_in(inner)
        if found is not None:
            return found
    return None


def _value_at(raw: Any, path: str) -> Any:
    for part in re.findall(r"[^.\[\]]+|\[[^\]]*\]", path):
        if part.startswith("["):
            index = part[1:-1]
            if not isinstance(raw, list) or not index.isdecimal() or int(index) >= len(raw):
                return None
            raw = raw[int(index)]
        elif isinstance(raw, dict) and part in raw:
            raw = raw[part]
        else:
            return None
    return raw if not isinstance(raw, (dict, list)) else None


def _range(root: Any, path: str) -> str:
    """The range of the number a key holds, `50 to 1000000`; empty where it has none."""
    parent, _, key = re.sub(r"\[[^\]]*\]", "", path).rpartition(".")
    struct = _struct_at(root, parent) or root
    hint = next((f.type for f in msgspec.structs.fields(struct) if f.encode_name == key), None)
    return next((text for meta in metas(hint) if (text := range_text(meta))), "")


def metas(hint: Any) -> list[msgspec.Meta]:
    """Every Meta in a type, outermost first."""
    found = (
        [one for one in get_args(hint)[1:] if isinstance(one, msgspec.Meta)] if get_origin(hint) is Annotated else []
    )
    inner = get_args(hint)[:1] if get_origin(hint) is Annotated else get_args(hint)
    return found + [one for part in inner if get_origin(part) is not Literal for one in metas(part)]


def range_text(meta: msgspec.Meta) -> str:
    """`above 0 to 20`; empty where a Meta says nothing of numbers."""
    low = f"above {number_text(meta.gt)}" if meta.gt is not None else "" if meta.ge is None else number_text(meta.ge)
    high = f"below {number_text(meta.lt)}" if meta.lt is not None else "" if meta.le is None else number_text(meta.le)
    if low and high:
        return f"{low} to {high}"
    return low and (low if low.startswith("above") else f"at least {low}") or high and f"at most {high}"


def number_text(value: float) -> str:
    """A number as a person writes it: 3600000, not 3.6e+06."""
    return str(int(value)) if value == int(value) and abs(value) < 1e16 else f"{value:g}"
