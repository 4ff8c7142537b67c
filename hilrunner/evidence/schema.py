"""Record layouts of a log, taken from the log's own schemas and mapped onto ours by field name."""

import re

import numpy as np

from hilrunner.base import records
from hilrunner.base.records import MESSAGE_OFFSET

_SIZES = {
    "bool": "u1", "byte": "u1", "char": "u1",
    "uint8": "u1", "uint16": "u2", "uint32": "u4", "uint64": "u8",
    "int8": "i1", "int16": "i2", "int32": "i4", "int64": "i8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_SCHEMA_BYTES_MAX = 1 << 16  # of the text; ours have some 5000
_MESSAGE_BYTES_MAX = 1 << 16
_AXIS = "[A-Za-z0-9_.-]{1,64}"
_FIELD = re.compile(r"^\s*(\w+)(?:\[([0-9]{1,6})\])?\s+([A-Za-z]\w*)\s*$")


def layout_of(schema_text: str) -> np.dtype | None:
    """Memory layout of a message whose ros2msg definition has only fixed-size fields; None for any other.

    Returns a dtype with the 4 unused bytes and the CDR header in front (base.records), fields aligned as plain CDR
    aligns them, counted from after the header (OMG DDS-XTypes 7.4.3).
    """
    if len(schema_text) > _SCHEMA_BYTES_MAX:
        return None
    names, formats, offsets = ["unused", "cdr"], [("u1", (4,)), ("u1", (4,))], [0, 4]
    taken = set(names)
    position = 0
    for line in schema_text.splitlines():
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        match = _FIELD.match(text)
        if match is None or match[1] not in _SIZES or match[3] in taken:
            return None
        taken.add(match[3])
        code = _SIZES[match[1]]
        size, count = int(code[1:]), int(match[2] or 1)
        position = -(-position // size) * size
        names.append(match[3])
        formats.append((f"<{code}", (count,)) if match[2] else f"<{code}")
        offsets.append(8 + position)
        position += size * count
        if position > _MESSAGE_BYTES_MAX:
            return None
    if len(names) == 2:
        return None
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 8 + position})


def own_layout(topic: str, axis_names: list[str] | None = None) -> np.dtype | None:
    """Our layout for a topic; None for a topic that is not ours. CAN topics: the frame size is the log's matter."""
    fixed = {"/rt/tick": records.TICK, "/rt/miss": records.MISS, "/rt/statistics": records.STATISTICS}
    if topic in fixed:
        return fixed[topic]
    if topic in ("/can/rx", "/can/tx"):
        return records.CAN_FD_FRAME
    by_axis = {"command": records.COMMAND, "state": records.STATE, "check": records.CHECK, "dae": records.STATE}
    match = re.fullmatch(rf"/({_AXIS})/([a-z]+)", topic)
    if match and match[2] in by_axis and (axis_names is None or match[1] in axis_names):
        return by_axis[match[2]]
    return None


def select(layout: np.dtype, columns: tuple[str, ...] | None) -> np.dtype:
    """A layout with only `columns`, packed in that order; all of it for None."""
    if columns is None:
        return layout
    return np.dtype([(name, layout.fields[name][0]) for name in columns if name in layout.names])


def copy_spans(wire: np.dtype, keep: np.dtype) -> np.ndarray:
    """Which bytes of a payload (from the CDR header on) go where in a row of `keep`: int64[n, 3] for mcap_walk.gather.

    Fields of the same name and format are copied; neighbours in both are one span.
    """
    spans: list[list[int]] = []
    shared = [name for name in keep.names if name in wire.names and name != "unused"]
    for name in sorted(shared, key=lambda one: wire.fields[one][1]):
        (form, source), (own, place) = wire.fields[name][:2], keep.fields[name][:2]
        if form != own:
            continue
        source -= MESSAGE_OFFSET
        if spans and spans[-1][0] + spans[-1][1] == source and spans[-1][2] + spans[-1][1] == place:
            spans[-1][1] += form.itemsize
        else:
            spans.append([source, form.itemsize, place])
    return np.array(spans, np.int64).reshape(-1, 3)


def missing(wire: np.dtype, keep: np.dtype) -> tuple[str, ...]:
    """Fields of `keep` that `wire` lacks or has in another format."""
    return tuple(name for name in keep.names if name not in wire.names or wire.fields[name][0] != keep.fields[name][0])
