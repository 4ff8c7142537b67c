"""From the newest valid frame to the valve command of this period: control word, ageing, ramp, latched fail-safe.

Goals: firmware that dies never leaves the valve open; the same ticks and frames give the same command in any replay.
Invariants: age is counted in grid periods, never in wall-clock time; FAIL_SAFE is left by a Reset frame alone; the command
is 0 in every mode but ACTIVE, STALE_HOLD and STALE_RAMP; the command applied is always within -1..1. A safety line (Trip) latches
FAIL_SAFE from any mode.

    WAITING --valid--> DISABLED / HOLD / ACTIVE --no valid frame for stale_after--> STALE_HOLD --hold_for--> STALE_RAMP
            --ramp_for--> FAIL_SAFE (latched) --Reset--> HOLD;   a valid frame in STALE_* returns to its control word
"""

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import hot

# One row an axis. Periods are those of the profile's grid.
COMMAND_STATE = np.dtype(
    [
        ("valid_tick", "i8"),  # tick that received the newest valid frame; -1: none yet
        ("stale_after_ns", "i8"),  # constant: age from which the command is stale
        ("hold_for_ns", "i8"),  # constant: then held this long
        ("ramp_for_ns", "i8"),  # constant: then ramped to neutral in this time
        ("setpoint", "f8"),  # newest valid set point, -1..1
        ("applied", "f8"),  # command applied in the last period
        ("timestamp_us", "u4"),  # of the newest valid frame, echoed to the firmware
        ("control", "u1"),  # of the newest valid frame
        ("counter", "u1"),  # of the newest valid frame
        ("mode", "u1"),  # status.MODE_*
        ("status", "u1"),  # status.FRAME_* of the last frame of this tick; 255: none
    ],
    align=True,
)


def make_command_state(stale_after_ns: int, hold_for_ns: int, ramp_for_ns: int) -> np.ndarray:
    """The state of one axis before any frame, shape (1,)."""
    row = np.zeros(1, COMMAND_STATE)
    row["valid_tick"] = -1
    row["stale_after_ns"] = stale_after_ns
    row["hold_for_ns"] = hold_for_ns
    row["ramp_for_ns"] = ramp_for_ns
    row["status"] = 255
    return row


@hot
def accept(commands, axis, fresh):
    """Take a valid command; the newest of a tick wins. A safety line latches the fail-safe as a lost firmware does."""
    row = commands[axis]
    new = fresh[axis]
    row["valid_tick"] = new["valid_tick"]
    row["setpoint"] = new["valve_command"]
    row["timestamp_us"] = new["timestamp_us"]
    row["control"] = new["control"]
    row["counter"] = new["counter"]
    if new["control"] == status.CONTROL_TRIP:
        row["mode"] = status.MODE_FAIL_SAFE
    elif row["mode"] == status.MODE_FAIL_SAFE:
        if new["control"] == status.CONTROL_RESET:
            row["mode"] = status.MODE_HOLD
    else:
        row["mode"] = _mode_of_control(new["control"])


@hot
def _mode_of_control(control):
    if control == status.CONTROL_ACTIVE:
        return status.MODE_ACTIVE
    if control == status.CONTROL_DISABLED:
        return status.MODE_DISABLED
    return status.MODE_HOLD  # Hold, and Reset when there is nothing to reset


@hot
def age_ns(commands, axis, tick, period_ns):
    """Age of the newest valid command at this tick; -1 before the first."""
    row = commands[axis]
    if row["valid_tick"] < 0:
        return np.int64(-1)
    return np.int64((tick - row["valid_tick"]) * period_ns)


@hot
def apply_age(commands, axis, tick, period_ns):
    """Advance the mode by age and return the valve command of this period, -1..1."""
    row = commands[axis]
    age = age_ns(commands, axis, tick, period_ns)
    stale_ns = age - row["stale_after_ns"]
    if age >= 0 and stale_ns > 0 and row["mode"] != status.MODE_FAIL_SAFE:
        if stale_ns <= row["hold_for_ns"]:
            row["mode"] = status.MODE_STALE_HOLD
        elif stale_ns <= row["hold_for_ns"] + row["ramp_for_ns"]:
            row["mode"] = status.MODE_STALE_RAMP
        else:
            row["mode"] = status.MODE_FAIL_SAFE
    row["applied"] = _applied(row, stale_ns)
    return row["applied"]


@hot
def _applied(row, stale_ns):
    mode = row["mode"]
    setpoint = row["setpoint"] if row["control"] == status.CONTROL_ACTIVE else 0.0
    if mode == status.MODE_ACTIVE or mode == status.MODE_STALE_HOLD:
        return setpoint
    if mode == status.MODE_STALE_RAMP:
        return setpoint * (1.0 - (stale_ns - row["hold_for_ns"]) / row["ramp_for_ns"])
    return 0.0


@hot
def force_fail_safe(commands, axis):
    """Latch the fail-safe from outside the ageing (deadline limits, profile action)."""
    commands[axis]["mode"] = status.MODE_FAIL_SAFE
