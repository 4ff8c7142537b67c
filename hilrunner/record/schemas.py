"""The ros2msg text of every topic: the fields of base.records, each with its unit and meaning as a comment."""

import numpy as np

from hilrunner.base import records, status

_UNITS = {
    "_ns": "ns",
    "_us": "us",
    "_m": "m",
    "_mps": "m/s",
    "_pa": "Pa, gauge",
    "_n": "N",
}

_MEANINGS = {
    "tick": "period number on the grid; a gap is dropped (or skipped) periods",
    "deadline_mono_ns": "CLOCK_MONOTONIC: start_mono_ns + tick * period_ns",
    "wake_mono_ns": "CLOCK_MONOTONIC when the period began",
    "end_mono_ns": "CLOCK_MONOTONIC after the record phase",
    "record_ns": "record phase of the tick before",
    "skipped_count": "whole periods skipped just before this tick that have no row of their own",
    "valve_command": "-1..1, as applied to the plant",
    "age_ns": "since the tick that received the newest valid command; -1: none yet",
    "mode": "mode of the axis: " + ", ".join(f"{i} {name}" for i, name in enumerate(status.MODE_NAMES)),
    "control": "control word of the newest valid command: 0 disabled, 1 hold, 2 active, 3 reset, 4 tripped by a safety line",
    "counter": "alive counter of the newest valid command",
    "load_scale": "factor on the static load in this period",
    "lag_ns": "how far the check was behind the loop",
    "lateness_ns": "how far the tick ended past the end of its period",
    "can_id": "SocketCAN identifier with the EFF, RTR and ERR flags in the upper three bits",
    "length": "data bytes",
    "axis": "255: none",
    "kernel_real_ns": "CLOCK_REALTIME: the kernel's stamp; 0: none",
    "mono_ns": "CLOCK_MONOTONIC when the bench handled the frame",
    "cause": "suspected: " + ", ".join(f"{i} {name}" for i, name in enumerate(status.CAUSE_NAMES)),
    "phase": "longest phase: " + ", ".join(f"{i} {n}" for i, n in enumerate(status.PHASE_NAMES)) + ", 255 the wake-up",
}

_FRAME_STATUS = ", ".join(f"{i} {name}" for i, name in enumerate(status.FRAME_STATUS_NAMES)) + ", 255 none"

# said of the bit in the log: a reader knows by these words that the log tells where a limit forced the fail-safe
FORCED_FAIL_SAFE = "fail-safe forced just before this tick by a deadline limit"

# the same field name with another meaning by message
_MEANINGS_BY_MESSAGE = {
    ("Tick", "flags"): (
        f"bit 0: late (a miss), bit 1: near a miss, bit 2: {FORCED_FAIL_SAFE}, bit 3: skipped, computed after a stall"
    ),
    ("State", "flags"): ", ".join(f"bit {i}: {name}" for i, name in enumerate(status.FLAG_NAMES)),
    ("Check", "flags"): "bit 0: out of tolerance, bit 1: restarted behind a gap, no errors at this tick",
    ("CanFrame", "flags"): "bit 0: FD, bit 1: BRS, bit 7: sent by the bench",
    ("Command", "status"): "last frame of this tick for this axis: " + _FRAME_STATUS,
    ("CanFrame", "status"): "received frames: " + _FRAME_STATUS,
    ("Miss", "skipped_count"): "periods lost to this miss",
}

LOG_SCHEMA_NAME = "rcl_interfaces/msg/Log"
LOG_SCHEMA_TEXT = """builtin_interfaces/Time stamp
uint8 level # 10 debug, 20 info, 30 warning, 40 error, 50 fatal
string name
string msg
string file
string function
uint32 line
================================================================================
MSG: builtin_interfaces/Time
int32 sec # s
uint32 nanosec # ns
"""


def _comment(message: str, field: str) -> str:
    meaning = _MEANINGS_BY_MESSAGE.get((message, field)) or _MEANINGS.get(field, "")
    unit = next((text for suffix, text in _UNITS.items() if field.endswith(suffix)), "")
    if "_ns_" in field:  # a statistic: percentile behind the unit
        unit = "ns"
    return "; ".join(part for part in (unit, meaning) if part)


def schema_text(message: str, dtype: np.dtype) -> str:
    """The definition of one message: `records.schema_text` with a comment of unit and meaning on each line."""
    lines = []
    for line in records.schema_text(dtype).splitlines():
        comment = _comment(message, line.split()[-1])
        lines.append(f"{line} # {comment}" if comment else line)
    return "\n".join(lines) + "\n"
