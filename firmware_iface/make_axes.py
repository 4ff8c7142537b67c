"""Write the messages of axes 2..N of a DBC from those of axis 1: same layout, own identifiers and Data IDs.

    python make_axes.py actuator.dbc --axes 4            rewrites actuator.dbc
    python make_axes.py actuator.dbc --axes 9 --out my.dbc

Axis 1 is the source; whatever the file holds for other axes is replaced. Needs nothing but Python.
Data IDs: message number n = 4 (k - 1) + place in MESSAGES + 1, Data ID of counter c = n (c + 1) mod 251. As 251 is a prime,
two messages differ in the Data ID of every counter value, so that no frame passes for another one. HEAVE came later and counts
from the other end, n = 251 - k, so that the four others kept their Data IDs.
"""

import argparse
import re
from pathlib import Path

MESSAGES = ("VALVE_COMMAND", "PRESSURES", "MOTION", "BENCH_STATUS", "HEAVE")
AXIS_COUNT_MAX = 50  # 5 * 50 < 251 distinct Data IDs

_ID = re.compile(r"\b(?:BO_|SG_|VAL_) (\d+) ")
_NAME = re.compile(rf"\b({'|'.join(MESSAGES)})_1\b")


def data_id_list(message: str, axis: int) -> list[int]:
    """The 16 Data IDs of one message of one axis (from 1)."""
    number = 251 - axis if message == "HEAVE" else 4 * (axis - 1) + MESSAGES.index(message) + 1
    return [number * (counter + 1) % 251 for counter in range(16)]


def _for_axis(block: str, axis: int, names: dict[int, str]) -> str:
    """One statement (or message block) of axis 1, rewritten for another axis."""
    can_id = int(_ID.search(block).group(1))
    text = _ID.sub(lambda m: m.group(0).replace(m.group(1), str(can_id + axis - 1)), block)
    text = _NAME.sub(lambda m: f"{m.group(1)}_{axis}", text)
    if '"E2EDataIdList"' in text:
        ids = " ".join(str(value) for value in data_id_list(names[can_id], axis))
        text = re.sub(r'"[\d ]*";$', f'"{ids}";', text)
    return text


def _blocks(text: str) -> list[str]:
    """Statements, a message with its signals as one block; blank lines are blocks of their own."""
    blocks: list[str] = []
    for line in text.splitlines():
        if line.startswith(" SG_"):
            blocks[-1] += "\n" + line
        else:
            blocks.append(line)
    return blocks


def with_axes(text: str, axis_count: int) -> str:
    """The DBC text with axes 1..axis_count."""
    if not 1 <= axis_count <= AXIS_COUNT_MAX:
        raise ValueError(f"axis count {axis_count}: allowed 1..{AXIS_COUNT_MAX}")
    blocks = _blocks(text)
    declared = re.findall(rf"^BO_ (\d+) ({'|'.join(MESSAGES)})_(\d+):", text, re.MULTILINE)
    names = {int(can_id): name for can_id, name, axis in declared if axis == "1"}
    others = {int(can_id) for can_id, _, axis in declared if axis != "1"}
    out: list[str] = []
    for block in blocks:
        found = _ID.search(block)
        can_id = int(found.group(1)) if found else None
        if can_id in others:
            if block.startswith("BO_ ") and out and out[-1] == "":
                out.pop()
            continue
        out.append(block)
        if can_id in names:
            for axis in range(2, axis_count + 1):
                if block.startswith("BO_ "):
                    out.append("")
                out.append(_for_axis(block, axis, names))
    return "\n".join(out) + "\n"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dbc", type=Path)
    parser.add_argument("--axes", type=int, required=True)
    parser.add_argument("--out", type=Path, help="default: the DBC itself")
    arguments = parser.parse_args()
    text = with_axes(arguments.dbc.read_text(encoding="utf-8"), arguments.axes)
    (arguments.out or arguments.dbc).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
