"""The signals that a requirement may name, derived from the layouts of the log: every field of an axis' states and commands, and its flags.

`luffing.rod_position` is the field `rod_position_m` of `/luffing/state`: the unit leaves the name, because in a formula every number carries its own.
A bench of one axis may leave the axis out. `mode` holds one of its words; a flag is true or false.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hilrunner.base import records, status
from hilrunner.requirements.dimension import NONE, SUFFIXES, UNITS
from hilrunner.requirements.parse import SignalKind
from hilrunner.requirements.requirement import Requirement, Written, understand

_NOT_SIGNALS = ("unused", "cdr", "tick", "flags", "status", "counter", "control", "echoed_timestamp_us", "mode")


@dataclass(frozen=True)
class Source:
    """Where the log holds a signal: `/<axis>/<topic>`, its field, and the factor to SI; `flag` is the bit of a flag."""

    axis: str
    topic: str
    field: str
    factor: float
    kind: SignalKind
    flag: int = 0


def sources(axis_names: Iterable[str]) -> dict[str, Source]:
    """Every signal of these axes, by name."""
    names = tuple(axis_names)
    found: dict[str, Source] = {}
    for axis in names:
        own = _of_axis(axis)
        found |= {f"{axis}.{name}": source for name, source in own.items()}
        if len(names) == 1:
            found |= own
    return found


def _of_axis(axis: str) -> dict[str, Source]:
    found = {}
    for topic, dtype in (("state", records.STATE), ("command", records.COMMAND)):
        found |= _fields(axis, topic, dtype)
    mode = SignalKind(NONE, words=tuple(status.MODE_NAMES))
    found["mode"] = Source(axis, "command", "mode", 1.0, mode)
    for bit, name in enumerate(status.FLAG_NAMES):
        word = name.replace(" ", "_").replace("-", "_")
        found[word] = Source(axis, "state", "flags", 1.0, SignalKind(NONE, truth=True), 1 << bit)
    return found


def _fields(axis: str, topic: str, dtype: np.dtype) -> dict[str, Source]:
    found = {}
    for field in dtype.names:
        if field in _NOT_SIGNALS:
            continue
        stem, _, suffix = field.rpartition("_")
        unit = UNITS.get(SUFFIXES.get(suffix, ""))
        if unit is None:  # a plain number: valve_command, load_scale
            stem, unit = field, UNITS["1"]
        found[stem] = Source(axis, topic, field, unit.factor, SignalKind(unit.dimension))
    return found


def requirements_of(written: tuple[Written, ...], axis_names: Iterable[str], place: str) -> list[Requirement]:
    """The requirements of a profile or a file, understood.

    Raises:
        UsageError: a formula that does not fit the signals of these axes.
    """
    return understand(written, {name: source.kind for name, source in sources(axis_names).items()}, place)
