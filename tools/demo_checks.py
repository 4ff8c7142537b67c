"""What must hold after the demo's scenes, read from the logs, the bus and the programs' own words."""

from pathlib import Path
from typing import NamedTuple

import cantools
import numpy as np
from demo_scenes import TICKS_RUN_RATIO_MIN

from hilrunner.base import records, status
from hilrunner.base.exit_codes import PASSED
from hilrunner.evidence.reader import Run, read_run
from hilrunner.setup.profile import load_profile

ROOT = Path(__file__).resolve().parent.parent
DBC = ROOT / "firmware_iface" / "actuator.dbc"
CLOSED_LOOP_S_MIN = 20.0
TRACKING_RATIO_MAX = 0.02  # RMS error of the rod over RMS of the reference motion
GRACE_TICKS = 2


class Check(NamedTuple):
    """One line of the table."""

    scene: str
    what: str
    found: str
    required: str
    ok: bool


def judge(out: Path, scenes: dict, codes: dict[str, int]) -> list[Check]:
    """Every check of the demo."""
    return [
        *closed_loop(out, scenes["closed_loop"], codes),
        *firmware_lost(out, scenes["firmware_lost"]),
        *runner_killed(out, scenes["runner_killed"]),
    ]


def _exit(scene: str, what: str, code: int) -> Check:
    return Check(scene, what, f"exit code {code}", f"exit code {PASSED}", code == PASSED)


def _period_s(run: Run) -> float:
    return int(run.metadata["run"]["period_ns"]) * 1e-9


def ticks_complete(run: Run) -> tuple[bool, str]:
    """Every period from tick 0 to the last is in the log or counted as skipped."""
    tick = run.tick["tick"].astype(np.int64)
    skipped = run.tick["skipped_count"].astype(np.int64)
    expected = np.diff(tick, prepend=-1) - 1
    told = run.metadata.get("run", {})
    lost = int(np.abs(expected - skipped).sum()) + int(told.get("dropped_ticks", 0)) + int(told.get("lost_messages", 0))
    ran = _ticks_run(run)
    return lost == 0 and ran > 0, f"{ran} ticks, {len(tick) - ran + int(skipped.sum())} skipped, {lost} lost"


def _ticks_run(run: Run) -> int:
    """Ticks that ran in time or late; skipped periods have rows as well."""
    return int(np.count_nonzero((run.tick["flags"] & records.TICK_FLAG_SKIPPED) == 0))


def closed_loop(out: Path, scene: dict, codes: dict[str, int]) -> list[Check]:
    """The healthy run."""
    name = "closed loop"
    run = read_run(out / "closed-loop.mcap")
    (axis,) = run.axis_names
    command = run.command[axis]
    active_s = float((command["mode"] == status.MODE_ACTIVE).sum() * _period_s(run))
    ran = _ticks_run(run) / (int(run.tick["tick"][-1]) + 1)
    firmware = scene["firmware"]
    error, reference = firmware["tracking_error_mm_rms"], firmware["reference_mm_rms"]
    complete, text = ticks_complete(run)
    decoded = (out / "decoded.txt").read_text()
    return [
        _exit(name, "hilrunner --can vcan0", scene["exit_code"]),
        Check(name, "firmware in charge of the valve", f"{active_s:.1f} s", f">= {CLOSED_LOOP_S_MIN:g} s", active_s >= CLOSED_LOOP_S_MIN),
        Check(name, f"periods run on the grid of {1e3 * _period_s(run):g} ms", f"{100 * ran:.2f} %", f">= {100 * TICKS_RUN_RATIO_MIN:g} %", ran >= TICKS_RUN_RATIO_MIN),
        Check(
            name, "rod follows the wave, RMS error", f"{error:.3f} mm of {reference:.1f} mm",
            f"<= {100 * TRACKING_RATIO_MAX:g} %", reference > 1.0 and error <= TRACKING_RATIO_MAX * reference,
        ),
        Check(name, "log whole, every period accounted for", text, "0 lost, no damage", complete and run.finished and not run.damage),
        Check(name, "bus decodes with actuator.dbc", f"{decoded.count('VALVE_COMMAND_1')} commands, {decoded.count('MOTION_1')} motions", "both seen", "VALVE_COMMAND_1" in decoded and "MOTION_1" in decoded and codes["decode"] == 0),
        _exit(name, "hilrunner report (verdict)", codes["report"]),
        _exit(name, "hilrunner replay (bit for bit, DAE)", codes["replay"]),
    ]  # fmt: skip


def firmware_lost(out: Path, scene: dict) -> list[Check]:
    """The run whose firmware died and came back."""
    name = "firmware lost"
    run = read_run(out / "firmware-lost.mcap")
    (axis,) = run.axis_names
    command = run.command[axis]
    rules = load_profile("amc-lift").profile.axis[0].command
    limit_ms = rules.stale_after_ms + rules.hold_for_ms + rules.ramp_for_ms + GRACE_TICKS * _period_s(run) * 1e3
    mode = command["mode"]
    entered = np.flatnonzero((mode[1:] == status.MODE_FAIL_SAFE) & (mode[:-1] != status.MODE_FAIL_SAFE)) + 1
    # a late tick finds the age it has: the periods skipped just before it are the grid's, not the ageing's
    ages_ms = command["age_ns"][entered] * 1e-6 - run.tick["skipped_count"][entered] * _period_s(run) * 1e3
    in_fail_safe = mode == status.MODE_FAIL_SAFE
    neutral = bool((command["valve_command"][in_fail_safe] == 0.0).all())
    after = mode[entered[0] :] if len(entered) else mode[:0]
    order = [status.MODE_NAMES[m] for m in mode[np.flatnonzero(np.diff(mode, prepend=255))]]
    complete, text = ticks_complete(run)
    return [
        _exit(name, "hilrunner --can vcan0 (fail-safe is no failure)", scene["exit_code"]),
        Check(
            name, "latched fail-safe after the last command", ", ".join(f"{age:.0f} ms" for age in ages_ms) or "never",
            f"<= {limit_ms:g} ms", len(ages_ms) > 0 and float(ages_ms.max()) <= limit_ms,
        ),
        Check(name, "stale hold, ramp, fail-safe in this order", " > ".join(order[:7]), "stale-hold > stale-ramp > fail-safe", "stale-hold > stale-ramp > fail-safe" in " > ".join(order)),
        Check(name, "valve neutral in fail-safe", "yes" if neutral else "no", "yes", neutral and bool(in_fail_safe.any())),
        Check(name, "seen on the bus (BENCH_STATUS)", f"{_fail_safe_frames(run)} frames", "> 0", _fail_safe_frames(run) > 0),
        Check(name, "new firmware takes over by Reset", f"{int((after == status.MODE_ACTIVE).sum())} active ticks after", "> 0", bool((after == status.MODE_ACTIVE).any())),
        Check(name, "log whole", text, "0 lost, no damage", complete and run.finished and not run.damage),
    ]  # fmt: skip


def _fail_safe_frames(run: Run) -> int:
    message = cantools.database.load_file(DBC).get_message_by_name("BENCH_STATUS_1")
    rows = run.can_tx[run.can_tx["can_id"] == message.frame_id]
    states = (message.decode(bytes(row["data"][: row["length"]]), decode_choices=False) for row in rows)
    return sum(state["bench_state"] == status.MODE_FAIL_SAFE for state in states)


def runner_killed(out: Path, scene: dict) -> list[Check]:
    """The run whose runner was killed."""
    name = "runner killed"
    run = read_run(out / "runner-killed.mcap")
    complete, text = ticks_complete(run)
    last_in_log = int(run.tick["tick"][-1])
    message = cantools.database.load_file(DBC).get_message_by_name("BENCH_STATUS_1")
    last_on_bus = message.decode(bytes.fromhex(scene["status_frame"]), decode_choices=False)["tick"]
    signal = message.get_signal_by_name("tick")
    behind = (last_on_bus - last_in_log) % (1 << signal.length)
    if behind >= 1 << (signal.length - 1):
        behind -= 1 << signal.length
    closed = scene["closed_after_s"]
    return [
        Check(name, "recorder finished the log", f"{closed} s after the kill", "finished", closed is not None and run.finished),
        Check(name, "every period up to the kill", text, "0 lost, no damage", complete and not run.damage),
        Check(name, "last tick on the bus is in the log", f"{max(0, behind)} ticks behind", "<= 1", behind <= 1),
        Check(name, "log says what happened", run.metadata.get("run", {}).get("exit_reason", "nothing"), "runner killed", run.metadata.get("run", {}).get("exit_reason") == "runner killed"),
    ]  # fmt: skip


def print_table(checks: list[Check]) -> None:
    """Aligned columns, one line a check."""
    head = Check("scene", "check", "found", "required", True)
    rows = [head, *checks]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for row in rows:
        mark = "" if row is head else ("ok" if row.ok else "FAILED")
        print("  " + "  ".join(text.ljust(width) for text, width in zip(row[:4], widths, strict=True)) + "  " + mark)
