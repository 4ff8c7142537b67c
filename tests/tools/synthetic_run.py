"""Logs of runs that never took place: seeded, of any length, with every topic, for tests of what reads them.

python -m tests.tools.synthetic_run OUT.mcap --duration 3600        one hour at 1 kHz in a few seconds
"""

import argparse
from pathlib import Path

import numpy as np

from hilrunner.base import records, status
from hilrunner.record.mcap_log import LogWriter

PERIOD_NS = 1_000_000
START_MONO_NS = 5_000_000_000_000
START_REAL_NS = 1_790_000_000_000_000_000
BLOCK_TICKS = 50_000
AXIS = "lift"
PROFILE = """name = "synthetic"
[[axis]]
name = "lift"
[limits]
deadline_misses_max = 50
wake_lateness_us_p999 = 300.0
pressure_mpa_max = 30.0
check_pressure_mpa_max = 0.02
settling_ms_max = 500.0
"""


def valve(times_s: np.ndarray) -> np.ndarray:
    """A slow triangle of commands with pauses, -1..1."""
    phase = np.mod(times_s, 8.0)
    shape = np.interp(phase, [0, 0.5, 2.5, 3.0, 4.0, 4.5, 6.5, 7.0, 8.0], [0, 0.8, 0.8, 0, 0, -0.8, -0.8, 0, 0])
    return shape


def ticks_of(first: int, count: int, rng: np.random.Generator, stall_every: int) -> tuple[np.ndarray, np.ndarray]:
    """TICK and MISS records of grid periods first .. first+count; every `stall_every`-th tick stalls for 3.2 periods."""
    grid = np.arange(first, first + count)
    stalled = (grid % stall_every) == stall_every - 1
    skipped_by = np.zeros(count, bool)
    for lag in (1, 2):  # a tick that ends 3.2 periods late loses two whole ones; the next starts at once, late
        skipped_by[lag:] |= stalled[:-lag]
    kept = ~skipped_by
    tick = records.allocate(records.TICK, int(kept.sum()))
    number, late = grid[kept], stalled[kept]
    n = len(number)
    tick["tick"] = number
    tick["deadline_mono_ns"] = START_MONO_NS + number * PERIOD_NS
    wake = rng.lognormal(np.log(20_000), 0.4, n).astype(np.int64)
    after = np.flatnonzero(late) + 1
    after = after[after < n]
    wake[after] = 200_000
    tick["skipped_count"][after] = 2
    tick["wake_mono_ns"] = tick["deadline_mono_ns"] + wake
    for name, mean in (
        ("receive_ns", 3000),
        ("decode_ns", 800),
        ("step_ns", 12_000),
        ("encode_ns", 9000),
        ("record_ns", 900),
    ):
        tick[name] = rng.lognormal(np.log(mean), 0.2, n).astype(np.uint32)
    tick["step_ns"][late] = 3_150_000
    work = sum(tick[name].astype(np.int64) for name in ("receive_ns", "decode_ns", "step_ns", "encode_ns", "record_ns"))
    tick["end_mono_ns"] = tick["wake_mono_ns"] + work
    tick["frames_received"] = 1
    tick["flags"][late] = records.TICK_FLAG_MISS | records.TICK_FLAG_NEAR_MISS
    miss = records.allocate(records.MISS, int(late.sum()))
    rows = tick[late]
    miss["tick"] = rows["tick"]
    miss["lateness_ns"] = rows["end_mono_ns"] - rows["deadline_mono_ns"] - PERIOD_NS
    miss["wake_lateness_ns"] = rows["wake_mono_ns"] - rows["deadline_mono_ns"]
    miss["execution_ns"] = rows["end_mono_ns"] - rows["wake_mono_ns"]
    miss["switches_involuntary"] = 1
    miss["phase"] = status.PHASE_STEP
    miss["cause"] = np.where(np.arange(len(miss)) % 2, status.CAUSE_STEP, status.CAUSE_PREEMPTED)
    return tick, miss


def plant_of(tick: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """COMMAND, STATE and CHECK records: a rod that follows the valve at 22 mm/s, pressures that look like a hold."""
    n = len(tick)
    times_s = tick["tick"] * (PERIOD_NS * 1e-9)
    command = records.allocate(records.COMMAND, n)
    command["tick"] = tick["tick"]
    command["valve_command"] = valve(times_s)
    command["age_ns"] = 0
    command["mode"] = status.MODE_ACTIVE
    command["control"] = status.CONTROL_ACTIVE
    command["counter"] = tick["tick"] % 16
    state = records.allocate(records.STATE, n)
    state["tick"] = tick["tick"]
    state["rod_velocity_mps"] = 0.0225 * command["valve_command"]
    state["rod_position_m"] = 0.6 + 0.02 * np.sin(2 * np.pi * times_s / 8)
    state["chamber_1_pressure_pa"] = 9.1e6 + 2e5 * command["valve_command"] + rng.normal(0, 2e3, n)
    state["chamber_2_pressure_pa"] = 0.6e6 + 1e5 * np.abs(command["valve_command"]) + rng.normal(0, 1e3, n)
    state["load_force_n"] = 703.9e3
    state["load_scale"] = 1.0
    check = records.allocate(records.CHECK, n)
    check["tick"] = tick["tick"]
    pairs = (
        ("rod_position", "_m", 2e-6),
        ("rod_velocity", "_mps", 1e-5),
        ("chamber_1_pressure", "_pa", 900.0),
        ("chamber_2_pressure", "_pa", 700.0),
    )
    for name, unit, deviation in pairs:
        error = rng.normal(0, deviation, n)
        check[f"{name}_error{unit}"] = error
        check[f"reference_{name}{unit}"] = state[f"{name}{unit}"] - error
        check[f"one_step_{name}_error{unit}"] = error * 0.01
    check["lag_ns"] = 40_000_000
    return command, state, check


def frames_of(tick: np.ndarray, rng: np.random.Generator, data_size: int) -> np.ndarray:
    """One received and three sent frames a tick, in order."""
    n = len(tick)
    frames = records.allocate(records.can_frame_record(data_size), 4 * n)
    for offset, can_id in enumerate((0x201, 0x181, 0x281, 0x381)):
        rows = frames[offset::4]
        rows["tick"] = tick["tick"]
        rows["can_id"] = can_id
        rows["length"] = 8
        rows["data"][:, :8] = rng.integers(0, 256, (n, 8), dtype=np.uint8)
        rows["mono_ns"] = tick["wake_mono_ns"] if offset == 0 else tick["end_mono_ns"] - 2000
        arrival = tick["deadline_mono_ns"] - 300_000
        stamp = arrival if offset == 0 else rows["mono_ns"]
        rows["kernel_real_ns"] = stamp + (START_REAL_NS - START_MONO_NS)
        rows["flags"] = 0 if offset == 0 else records.CAN_FRAME_SENT
        rows["axis"] = 0 if offset == 0 else 255
    return frames


def run_metadata() -> dict[str, dict[str, str]]:
    """The `run` and `host` tables as a run writes them at its start."""
    return {
        "run": {
            "profile": "synthetic",
            "axis_names": AXIS,
            "period_ns": str(PERIOD_NS),
            "warm_up_ticks": "0",
            "start_mono_ns": str(START_MONO_NS),
            "start_real_ns": str(START_REAL_NS),
            "seed": "1",
            "bitrate": "1000000",
        },
        "host": {"mode_label": "simulated clock", "finding.clock": "no wall clock in this run"},
    }


def write_run(
    path: str | Path,
    tick_count: int,
    seed: int = 1,
    stall_every: int = 7_777,
    data_size: int = 8,
    profile_text: str = PROFILE,
    edit=None,
    metadata: dict[str, dict[str, str]] | None = None,
) -> Path:
    """Write a log of `tick_count` grid periods.

    Args:
        edit: called with a dict of the arrays of each block before they are written; may change them in place.
        metadata: entries to add to the tables, or to put in place of theirs; the counts of the end are those of the records
            before `edit`.
    """
    rng = np.random.default_rng(seed)
    attachments = [("profile.toml", "application/toml", profile_text.encode())]
    tables = run_metadata()
    counts = dict.fromkeys(("tick_count", "frame_records", "miss_records"), 0)
    outcomes: dict[str, int] = {}
    for name, entries in (metadata or {}).items():
        tables[name] = tables.get(name, {}) | entries
    writer = LogWriter(path, [AXIS], data_size, tables, attachments)
    for first in range(0, tick_count, BLOCK_TICKS):
        tick, miss = ticks_of(first, min(BLOCK_TICKS, tick_count - first), rng, stall_every)
        command, state, check = plant_of(tick, rng)
        frames = frames_of(tick, rng, data_size)
        block = {"tick": tick, "miss": miss, "command": command, "state": state, "check": check, "can": frames}
        for key, kind in (("tick_count", "tick"), ("frame_records", "can"), ("miss_records", "miss")):
            counts[key] += len(block[kind])
        if edit is not None:
            edit(block)
        _count_outcomes(block["can"], outcomes)
        write_block(writer, block)
    writer.write_log(20, "recorder", "synthetic run", START_REAL_NS)
    writer.close(_closing(tables, counts, outcomes, metadata or {}))
    return Path(path)


def _count_outcomes(frames: np.ndarray, outcomes: dict[str, int]) -> None:
    received = frames[(frames["flags"] & records.CAN_FRAME_SENT) == 0]
    for code, count in zip(*np.unique(received["status"], return_counts=True), strict=True):
        name = f"{AXIS}.{status.FRAME_STATUS_NAMES[code]}"
        outcomes[name] = outcomes.get(name, 0) + int(count)


def _closing(tables: dict, counts: dict[str, int], outcomes: dict[str, int], given: dict) -> dict[str, dict[str, str]]:
    """The tables as the recorder writes them at the end."""
    ended = {"exit_reason": status.EXIT_NAMES[status.EXIT_DURATION], **counts}
    ended |= dict.fromkeys(("dropped_ticks", "dropped_frames", "dropped_misses", "lost_messages", "lost_bytes"), 0)
    run = {key: str(value) for key, value in ended.items()} | tables["run"] | given.get("run", {})
    return {"run": run, "frames": {key: str(count) for key, count in outcomes.items()} | given.get("frames", {})}


def write_block(writer: LogWriter, block: dict[str, np.ndarray]) -> None:
    """Hand a block to a log, or to what stands in its place."""
    for part in range(0, len(block["tick"]), 1000):  # as the recorder does: about a second at a time
        rows = slice(part, part + 1000)
        tick = block["tick"][rows]
        low, high = tick["tick"][0], tick["tick"][-1]
        writer.write_ticks(tick, block["command"][rows], block["state"][rows], START_MONO_NS, START_REAL_NS)
        publish = tick["deadline_mono_ns"] + (START_REAL_NS - START_MONO_NS)
        writer.write_check(AXIS, block["check"][rows], publish + 40_000_000, publish)
        can = block["can"]
        writer.write_can(can[(can["tick"] >= low) & (can["tick"] <= high)], START_MONO_NS, START_REAL_NS)
        miss = block["miss"]
        writer.write_miss(miss[(miss["tick"] >= low) & (miss["tick"] <= high)], START_REAL_NS, PERIOD_NS)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--duration", type=float, default=60.0, help="seconds at 1 kHz")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    path = write_run(arguments.out, int(arguments.duration * 1000), arguments.seed)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
