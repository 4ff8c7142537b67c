"""Ageing of commands: hold, ramp, latched fail-safe, and what ends each. Interpreted and compiled give the same (rules lane)."""

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.realtime import command, decode

MS = 1_000_000
STALE_MS, HOLD_MS, RAMP_MS = 50, 50, 100


@entry
def _drive(rows, fresh, controls, values, applied, modes):
    """One tick a millisecond; controls[t] < 0: no frame in that tick."""
    for tick in range(controls.shape[0]):
        if controls[tick] >= 0:
            fresh[0]["control"] = controls[tick]
            fresh[0]["valve_command"] = values[tick]
            fresh[0]["valid_tick"] = tick
            command.accept(rows, 0, fresh)
        applied[tick] = command.apply_age(rows, 0, tick, 1_000_000)
        modes[tick] = rows[0]["mode"]


def drive(controls, values=None):
    """(applied, modes) for a control word (or -1) a tick."""
    controls = np.asarray(controls, np.int64)
    values = np.full(len(controls), 0.6) if values is None else np.asarray(values, float)
    rows = command.make_command_state(STALE_MS * MS, HOLD_MS * MS, RAMP_MS * MS)
    applied, modes = np.zeros(len(controls)), np.zeros(len(controls), np.int64)
    _drive(rows, decode.fresh_commands(1), controls, values, applied, modes)
    return applied, modes


def silence_after(ticks, total=400):
    controls = np.full(total, -1)
    controls[:ticks] = status.CONTROL_ACTIVE
    return controls


def test_before_the_first_command_the_valve_is_neutral():
    applied, modes = drive(np.full(500, -1))
    assert not applied.any() and (modes == status.MODE_WAITING).all()


@pytest.mark.parametrize(
    ("control", "mode", "value"),
    [
        (status.CONTROL_DISABLED, status.MODE_DISABLED, 0.0),
        (status.CONTROL_HOLD, status.MODE_HOLD, 0.0),
        (status.CONTROL_ACTIVE, status.MODE_ACTIVE, 0.6),
        (status.CONTROL_RESET, status.MODE_HOLD, 0.0),
        (status.CONTROL_TRIP, status.MODE_FAIL_SAFE, 0.0),
    ],
)
def test_only_active_moves_the_valve(control, mode, value):
    applied, modes = drive([control] * 10)
    assert (applied == value).all() and (modes == mode).all()


def test_silence_holds_then_ramps_then_latches():
    last = 9
    applied, modes = drive(silence_after(last + 1))
    stale, ramp, safe = last + STALE_MS, last + STALE_MS + HOLD_MS, last + STALE_MS + HOLD_MS + RAMP_MS
    assert (modes[last : stale + 1] == status.MODE_ACTIVE).all()
    assert (modes[stale + 1 : ramp + 1] == status.MODE_STALE_HOLD).all() and (
        applied[stale + 1 : ramp + 1] == 0.6
    ).all()
    assert (modes[ramp + 1 : safe + 1] == status.MODE_STALE_RAMP).all()
    assert (np.diff(applied[ramp : safe + 1]) < 0).all() and applied[safe] == pytest.approx(0.0, abs=1e-12)
    assert (modes[safe + 1 :] == status.MODE_FAIL_SAFE).all() and not applied[safe + 1 :].any()


def test_a_valid_frame_ends_the_hold_and_the_ramp():
    for gap in (STALE_MS + 20, STALE_MS + HOLD_MS + 40):
        controls = np.full(400, -1)
        controls[:10] = status.CONTROL_ACTIVE
        controls[9 + gap :] = status.CONTROL_ACTIVE
        applied, modes = drive(controls)
        assert (modes[9 + gap :] == status.MODE_ACTIVE).all() and (applied[9 + gap :] == 0.6).all()


def test_the_fail_safe_is_left_by_reset_alone():
    controls = silence_after(10, 700)
    controls[300:400] = status.CONTROL_ACTIVE
    controls[400:420] = status.CONTROL_HOLD
    controls[420] = status.CONTROL_RESET
    controls[421:] = status.CONTROL_ACTIVE
    applied, modes = drive(controls)
    assert (modes[300:420] == status.MODE_FAIL_SAFE).all() and not applied[300:420].any()
    assert modes[420] == status.MODE_HOLD and applied[420] == 0.0
    assert (modes[421:] == status.MODE_ACTIVE).all() and (applied[421:] == 0.6).all()


def test_silence_after_hold_stays_neutral_and_latches():
    controls = np.full(400, -1)
    controls[:10] = status.CONTROL_HOLD
    applied, modes = drive(controls)
    assert not applied.any() and modes[-1] == status.MODE_FAIL_SAFE


def test_age_counts_grid_periods():
    rows = command.make_command_state(STALE_MS * MS, HOLD_MS * MS, RAMP_MS * MS)
    assert command.age_ns.py_func(rows, 0, 5, MS) == -1
    rows[0]["valid_tick"] = 5
    assert command.age_ns.py_func(rows, 0, 8, MS) == 3 * MS


def test_zero_hold_and_ramp_latch_at_once():
    rows = command.make_command_state(STALE_MS * MS, 0, 0)
    fresh = decode.fresh_commands(1)
    applied, modes = np.zeros(100), np.zeros(100, np.int64)
    _drive(rows, fresh, silence_after(1, 100), np.full(100, 0.6), applied, modes)
    assert modes[STALE_MS] == status.MODE_ACTIVE and modes[STALE_MS + 1] == status.MODE_FAIL_SAFE
    assert np.isfinite(applied).all()
