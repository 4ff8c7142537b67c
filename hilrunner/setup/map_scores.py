"""How well a signal of an unknown database suits a quantity of the bench, by its name, unit and range: points, and why.

Words are taken from names as people write them (camel case, underscores, digits apart), in English and German.
"""

import re
from dataclasses import dataclass

from hilrunner.base.units import WIRE_UNITS

NAME_POINTS, UNIT_POINTS, MESSAGE_POINTS, RANGE_POINTS = 4, 3, 1, 1
LEAST_POINTS = 5  # a name alone, or a unit alone, is not enough


@dataclass(frozen=True)
class Use:
    """What a signal could be for: words that name it, words that speak against it, kind of unit (None: none needed)."""

    key: str
    names: tuple[str, ...]  # regular expressions over the signal's words, each followed by a blank
    against: tuple[str, ...] = ()
    kind: str | None = None


COMMANDS = (
    Use("valve_command", (r"\b(valve|spool|schieber|ventil)\b.*\b(cmd|command|set|setpoint|soll|demand|ref|position)?", r"\b(cmd|command|setpoint|soll|demand)\b", r"\b(valve|spool)\b"), (r"\b(status|act|actual|ist|feedback|fault)\b",), "ratio"),
    Use("magnitude", (r"\b(flow|magnitude|durchfluss|volumenstrom|stroke cmd)\b",), (r"\b(est|estimated|act|actual|ist)\b",), "ratio"),
    Use("direction", (r"\b(dir|direction|richtung)\b", r"\bstate\b"), (r"\b(machine|bench|fault)\b",)),
    Use("current_a", (r"\b(i|cur|current|strom|pwm|sol|solenoid|coil)\b.*\ba\b", r"\bi a\b"), (), "current"),
    Use("current_b", (r"\b(i|cur|current|strom|pwm|sol|solenoid|coil)\b.*\bb\b", r"\bi b\b"), (), "current"),
    Use("control", (r"\b(mode|control|ctrl|betriebsart)\b",), (r"\b(status|act|actual|fault)\b",)),
    Use("enable", (r"\b(enable|en|freigabe)\b",), ()),
    Use("dump", (r"\b(dump|unload|entlastung)\b",), ()),
    Use("safety", (r"\b(estop|e stop|emergency|safety|not halt|notaus)\b",), ()),
    Use("reset", (r"\b(reset|ack|quit)\b",), ()),
    Use("timestamp", (r"\b(time|timestamp|stamp|zeit)\b",), (), "timestamp"),
)  # fmt: skip
MEASUREMENTS = (
    Use("chamber_1_pressure", (r"\bp (1|a)\b", r"\bpressure.* (1|a)\b", r"\b(chamber|kammer) (1|a)\b", r"\b(bore|piston|head|kolben\w*|boden\w*)\b"), (r"\b(rod|stange|ring|pump|supply|tank)\b",), "pressure"),
    Use("chamber_2_pressure", (r"\bp (2|b)\b", r"\bpressure.* (2|b)\b", r"\b(chamber|kammer) (2|b)\b", r"\b(rod side|annulus|ring\w*|stangen\w*)\b"), (r"\b(pump|supply|tank)\b",), "pressure"),
    Use("supply_pressure", (r"\b(supply|pump|system|versorgung\w*|pumpen\w*)\b", r"\bp (s|p)\b"), (), "pressure"),
    Use("rod_position", (r"\b(pos|position|stroke|extension|length|lage|weg|hub)\b", r"\bx\b"), (r"\b(spool|valve|schieber|cmd|setpoint|soll|heave)\b",), "length"),
    Use("rod_velocity", (r"\b(vel|velocity|speed|geschw\w*|rate)\b", r"\bv\b"), (r"\b(heave|vessel|engine|soll)\b",), "velocity"),
    Use("spool_1_position", (r"\b(spool|schieber)\b.*\b(pos|position|act|ist|lage)?\b",), (r"\b(cmd|setpoint|soll)\b",), "length"),
    Use("load_force", (r"\b(force|load|kraft|last)\b",), (), "force"),
    Use("heave_position", (r"\bheave\b",), (r"\b(vel|velocity|speed|rate)\b",), "length"),
    Use("heave_velocity", (r"\bheave\b.*\b(vel|velocity|speed|rate)\b",), (), "velocity"),
    Use("bench_state", (r"\b(status|state|zustand)\b",), (r"\b(cmd|valve)\b",)),
)  # fmt: skip
COUNTER_NAMES = re.compile(r"\b(counter|cntr|cnt|alive|rolling|sequence|seq|zaehler|bz)\b")
CHECKSUM_NAMES = re.compile(r"\b(checksum|chksum|cksum|chk|crc|crc 8|pruefsumme)\b")
_SPOKEN_UNITS = {"percent": "%", "pct": "%", "perc": "%", "milliampere": "mA", "degc": "°C", "mm/sec": "mm/s"}


def words(name: str) -> str:
    """The words of a name in small letters: `P1_Cyl` and `PressureBoreSide` become `p 1 cyl` and `pressure bore side`."""
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    parts = re.sub(r"([A-Z]+)([A-Z][a-z])", r"\1 \2", parts)
    parts = re.sub(r"([A-Za-z])(\d)|(\d)([A-Za-z])", lambda m: " ".join(one for one in m.groups() if one), parts)
    text = " ".join(re.sub(r"[^A-Za-z0-9]+", " ", parts).lower().split())
    return re.sub(r"\b([pi])([ab])\b", r"\1 \2", text)  # pA, Ib


def unit_of(signal) -> str:
    """The signal's unit as the bench's table of units spells it, or as the database does."""
    unit = (signal.unit or "").strip()
    return _SPOKEN_UNITS.get(unit.casefold(), unit)


def points(use: Use, message, signal) -> tuple[int, str]:
    """(points, why) of a signal for a use; 0 where its unit or its name speaks against it."""
    name, around, unit = words(signal.name), words(message.name), unit_of(signal)
    if any(re.search(pattern, name) for pattern in use.against):
        return 0, ""
    total, why = 0, []
    if any(re.search(pattern, f"{name} ") for pattern in use.names):
        total, why = NAME_POINTS, ["the name"]
    elif any(re.search(pattern, f"{around} {name} ") for pattern in use.names):
        total, why = MESSAGE_POINTS, ["the message's name"]
    if use.kind is not None:
        fits = unit in WIRE_UNITS.get(use.kind, {}) if use.kind != "current" else unit in ("A", "mA")
        if unit and not fits:
            return 0, ""
        if unit:
            total, why = total + UNIT_POINTS, [*why, f"unit {unit}"]
        elif signal.length == 1:
            return 0, ""  # a line carries no measured value
    elif signal.length <= 8 and not unit:
        total, why = total + RANGE_POINTS, [*why, f"{signal.length} bits without a unit"]
    if signal.minimum is not None and signal.minimum < 0 and use.key in ("valve_command", "rod_velocity"):
        total, why = total + RANGE_POINTS, [*why, "both ways"]
    if use.key in ("magnitude",) and signal.minimum is not None and signal.minimum < 0:
        return 0, ""
    return total, ", ".join(why)


def index_words(text: str) -> frozenset[str]:
    """Words that tell one actuator from another: `boom`, `stick`, `left`, or a number."""
    known = r"\b(boom|arm|stick|dipper|bucket|jib|luff\w*|slew|swing|tilt|left|right|main|front|rear|knuckle|winch|lift|outer|inner|\d+)\b"
    return frozenset(re.findall(known, words(text)))
