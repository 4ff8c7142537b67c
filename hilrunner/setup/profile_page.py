"""docs/profiles.md, written from the structs that are the format: no key can be missing there, and none can be wrong."""

from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from msgspec import NODEFAULT, UNSET, Struct

from hilrunner.plant.parameters import PRESETS, SPEC
from hilrunner.plant.schedule import SCHEDULES
from hilrunner.realtime.encode import QUANTITY_NAMES
from hilrunner.setup import limits, mapping
from hilrunner.setup import profile as format_
from hilrunner.setup.profile_errors import metas, number_text, range_text

_UNITS = {
    "us": "us", "ms": "ms", "s": "s", "mm": "mm", "m": "m", "mmps": "mm/s", "mps": "m/s", "kn": "kN", "mpa": "MPa", "mm2": "mm^2", "mm3": "mm^3",
    "kg": "kg", "nspmm": "N s/mm", "npmm": "N/mm", "spmm": "s/mm", "n": "N", "sqrtmpa": "mm^3/s/MPa^0.5", "ratio": "1", "percent": "%",
}  # fmt: skip
_HEAD = """# Profiles: every key

A profile is one TOML file that says what a bench is. This page is printed by `tools/profile_keys` from the format itself
(`hilrunner/setup/profile.py`); a test compares the two. An unknown key, a wrong type or a value out of its range ends in one line with the place, the
value, the limit and the remedy (exit code 2). `hilrunner check FILE` tries a profile without bus and clock: it also refuses a plant that needs more RK4
steps a period than 25,000, or more time than its period on this machine.

The unit of a number is the end of its key. Files are named relative to the profile; a name alone is also looked for among the files that ship. For a
profile inside a log the log's own files are all there is (docs/log.md).
"""
_TABLES = (
    ("Top level", "", format_.Profile),
    ("`[bench]`", "", format_.Bench),
    ("`[[axis]]`", "", format_.Axis),
    ("`[axis.load]`", "", format_.Load),
    ("`[axis.wave]`", "", format_.Wave),
    ("`[axis.command]`", "", format_.CommandRules),
    ("`[can]`", "", format_.Can),
    ("`[[can.mapping]]`", "", mapping.AxisMapping),
    ("`[can.mapping.command]`", "", mapping.CommandMapping),
    ("`[[can.mapping.measurements]]`", "", mapping.MeasurementMapping),
    ("A signal of a mapping", "A text is the name of the signal, a table says more.", mapping.SignalMapping),
    ("A `direction` of a mapping", "", mapping.DirectionMapping),
    ("A line of a mapping", "A text is the name of the signal, a table says more.", mapping.LineMapping),
    ("`[[can.mapping.command.frames]]`", "", mapping.FrameMapping),
    ("A `protection` of a mapping", "", mapping.Protection),
    ("`[deadline]`", "", format_.Deadline),
    ("`[deadline.consecutive_misses]`, `[deadline.total_misses]`, `[deadline.lateness_us]`", "", format_.DeadlineLimit),
    ("`[deadline.stall_ms]`", "", format_.StallLimit),
    ("`[crosscheck]`", "", format_.CrossCheck),
    ("`[stimulus]`", "", format_.Stimulus),
    ("`[[fault]]`", "", format_.Fault),
    ("`[fault.when]`", "", format_.FaultCondition),
    ("`[[requirement]]`", "", format_.Requirement),
    ("`[[firmware]]`", "", format_.FirmwareProcess),
    ("`[virtual]`", "", format_.VirtualTime),
)


def page() -> str:
    """The whole page."""
    parts = [_HEAD]
    for title, more, struct in _TABLES:
        parts.append(f"## {title}\n{_sentences(struct)}{' ' + more if more else ''}\n\n{_table(struct)}")
    parts.append(_parameters())
    parts.append(_limits())
    parts.append(
        "## Words\n"
        f"Measured quantities (faults, mappings): {_listed(QUANTITY_NAMES)}.\n\n"
        f"Presets: {_listed(PRESETS)}.\n\nSchedules that ship: {_listed(sorted(SCHEDULES))}."
    )
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _sentences(struct: type[Struct]) -> str:
    return " ".join((struct.__doc__ or "").split())


def _table(struct: type[Struct]) -> str:
    rows = ["| key | unit | allowed | default | meaning |", "| --- | --- | --- | --- | --- |"]
    for one in msgspec.structs.fields(struct):
        told = next((meta.description for meta in metas(one.type) if meta.description), "")
        cells = (f"`{one.encode_name}`", unit_of(one.encode_name), _allowed(one.type), _default(one), told)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


def unit_of(key: str) -> str:
    """The unit a key ends in; empty for a number without one."""
    if key.endswith("_mm3ps_mpa"):
        return "mm^3/s/MPa"
    return _UNITS.get(key.rsplit("_", 1)[-1], "") if "_" in key else ""


def _allowed(hint: Any) -> str:
    inner = hint
    while get_origin(inner) is Annotated:
        inner = get_args(inner)[0]
    numbers = next((text for meta in metas(hint) if (text := range_text(meta))), "")
    if get_origin(inner) is Literal:
        return _listed(get_args(inner))
    if inner is bool:
        return "true, false"
    arguments = [one for one in get_args(inner) if one is not type(None)]
    if get_origin(inner) is Union or type(inner).__name__ == "UnionType":
        return " or ".join(dict.fromkeys(_allowed(one) for one in arguments))
    if inner is int or inner is float:
        return (
            numbers + (", whole" if inner is int else "")
            if numbers
            else "a whole number"
            if inner is int
            else "a number"
        )
    if inner is str:
        longest = next((meta.max_length for meta in metas(hint) if meta.max_length), None)
        return f"text of up to {longest} characters" if longest else "text"
    if isinstance(inner, type) and issubclass(inner, Struct):
        return "a table"
    if get_origin(inner) in (tuple, list):
        return _list_of(hint, inner)
    return "a table"


def _list_of(hint: Any, inner: Any) -> str:
    arguments = [one for one in get_args(inner) if one is not Ellipsis]
    each = _allowed(arguments[0])
    if get_origin(inner) is tuple and Ellipsis not in get_args(inner):
        return f"{len(arguments)} of {each}"
    most = next((meta.max_length for meta in metas(hint)[:1] if meta.max_length), None)
    of = "tables" if each == "a table" else each
    return f"a list of {of}" + (f", at most {most}" if most else "")


def _default(one) -> str:
    if one.required:
        return "needed"
    if (
        one.default is NODEFAULT
        or one.default is UNSET
        or isinstance(one.default, Struct)
        or one.default in ((), None, "")
    ):
        return ""
    value = one.default
    if isinstance(value, bool):
        return str(value).lower()
    return (
        f"`{value}`" if isinstance(value, str) else number_text(value) if isinstance(value, int | float) else str(value)
    )


def _parameters() -> str:
    names = list(PRESETS)
    rows = [f"| key | unit | allowed | {' | '.join(f'`{name}`' for name in names)} | meaning, source |"]
    rows.append("| --- " * (4 + len(names)) + "|")
    for row in SPEC:
        values = " | ".join(f"{PRESETS[name][row.key]:g}" for name in names)
        allowed = f"{row.minimum:g} to {row.maximum:g}"
        rows.append(f"| `{row.key}` | {unit_of(row.key)} | {allowed} | {values} | {row.doc}; {row.source} |")
    return "## `[axis.parameters]`\nConstants of the actuator, in place of the preset's.\n\n" + "\n".join(rows)


def _limits() -> str:
    rows = ["| key | unit | allowed | what is judged |", "| --- | --- | --- | --- |"]
    for spec in limits.SPEC:
        unit = next((_UNITS[part] for part in reversed(spec.key.split("_")) if part in _UNITS and part != "s"), "")
        rows.append(f"| `{spec.key}` | {unit} | {spec.lowest:g} to {spec.highest:g} | {spec.doc} |")
    return (
        "## `[limits]`\nWhat a run must keep to pass its verdict; a key that is absent is not judged (docs/verdict.md).\n\n"
        + "\n".join(rows)
    )


def _listed(words) -> str:
    return ", ".join(f"`{word}`" for word in words)
