"""Logs of runs as the loop makes them, without its clock: frames through `realtime.cycle.run_offline` into a LogWriter.

The frames are made by cantools and autosar-e2e, the ticks skip and miss by plan, so that every run is the same every time.
"""

import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hilrunner.base import records, status
from hilrunner.realtime.cycle import run_offline
from hilrunner.record.mcap_log import LogWriter
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.parcel import pack
from hilrunner.setup.profile import LoadedProfile, load_profile
from hilrunner.setup.run_manifest import run_files, run_metadata
from tests.tools import contract

PERIOD_NS = 1_000_000
START_MONO_NS = 7_000_000_000_000
START_REAL_NS = 1_790_000_000_000_000_000
PROFILE = """name = "replayed"

[[axis]]
name = "luffing"
circuit = "lift"
preset = "lift"
initial_position_mm = 600.0

[axis.wave]
significant_height_m = 0.5
peak_period_s = 8.0

[axis.command]
stale_after_ms = 20.0
hold_for_ms = 20.0
ramp_for_ms = 40.0

[deadline.lateness_us]
max = 5000
action = "fail-safe"

[limits]
pressure_mpa_max = 30.0
"""


@dataclass
class Plan:
    """What happens in a run; ticks are numbers on the grid.

    Args:
        skips: tick -> whole periods skipped just before it. late_us: tick -> how late it ended.
        silent: (first, last) ticks without commands. damaged: ticks whose frame has a bad CRC. resets: ticks with a Reset.
    """

    tick_count: int = 2000
    skips: dict[int, int] = field(default_factory=dict)
    late_us: dict[int, int] = field(default_factory=dict)
    silent: tuple[int, int] = (0, -1)
    damaged: tuple[int, ...] = ()
    resets: tuple[int, ...] = ()


EVENTFUL = Plan(
    skips={500: 2, 900: 7},
    late_us={300: 120, 1500: 6000},
    silent=(1000, 1200),
    damaged=(250, 251, 1300),
    resets=(1230, 1600),
)


def profile_at(folder: str | Path, text: str = PROFILE) -> LoadedProfile:
    """The text as a profile file in a folder."""
    path = Path(folder) / "profile.toml"
    path.write_text(text)
    return load_profile(str(path))


def make_run(
    path: str | Path,
    plan: Plan = EVENTFUL,
    text: str = PROFILE,
    engine: int = status.ENGINE_REFERENCE,
    alter=None,
    stimulus: np.ndarray | None = None,
    attach: bool = True,
) -> dict[str, np.ndarray]:
    """Run a plan and write its log; returns the arrays written.

    Args:
        alter: called with the loaded profile after the log's attachments are fixed and before the bench is built; what it
            returns is what runs (a bench that is not the one its log claims).
        stimulus: float64[tick, 1], commands in place of frames. attach: put it into the log, as a run does.
    """
    with tempfile.TemporaryDirectory() as folder:
        loaded = profile_at(folder, text)
        parcel = pack(loaded, engine, models=engine != status.ENGINE_REFERENCE)
        files = run_files(parcel, stimulus if attach else None)
        attachments = [(one.name, one.media_type, one.data) for one in files]
        metadata = run_metadata(loaded, files, engine, [], None)
        armed = arm_offline(loaded if alter is None else alter(loaded), engine, stimulus)
    tick = _ticks(plan)
    number = tick["tick"].astype(np.int64)
    rx, frames, sizes, first = _frames(plan if stimulus is None else replace(plan, silent=(0, plan.tick_count)), tick)
    miss, misses, forced = _misses(plan, number)
    tick["flags"][forced == 1] |= records.TICK_FLAG_FORCED_FAIL_SAFE
    command = records.allocate(records.COMMAND, len(tick)).reshape(-1, 1)
    state = records.allocate(records.STATE, len(tick)).reshape(-1, 1)
    periods = 1 + tick["skipped_count"].astype(np.int64)
    done = run_offline(armed.bench, number, periods, misses, forced, frames, sizes, first, command, state)
    assert done == len(tick)
    arrays = {"tick": tick, "command": command[:, 0], "state": state[:, 0], "miss": miss, "can": rx}
    _write(path, arrays, metadata, attachments, armed.loaded.profile.axis[0].name)
    return arrays


def valve_percent(times_s: np.ndarray) -> np.ndarray:
    """Set points: up, hold, down, hold; never the same for long while moving, -100..100."""
    shape = np.interp(
        np.mod(times_s, 2.0), [0, 0.1, 0.8, 0.9, 1.1, 1.2, 1.8, 1.9, 2.0], [0, 60, 90, 0, 0, -40, -70, 0, 0]
    )
    return np.round(shape / 100 * 16384) * 100 / 16384


def _ticks(plan: Plan) -> np.ndarray:
    lost = np.zeros(plan.tick_count, bool)
    for tick, count in plan.skips.items():
        lost[tick - count : tick] = True
    number = np.flatnonzero(~lost)
    rows = records.allocate(records.TICK, len(number))
    rows["tick"] = number
    rows["deadline_mono_ns"] = START_MONO_NS + number * PERIOD_NS
    rows["wake_mono_ns"] = rows["deadline_mono_ns"] + 30_000 + (number * 7919) % 20_000
    rows["end_mono_ns"] = rows["wake_mono_ns"] + 40_000
    for name in ("receive_ns", "decode_ns", "step_ns", "encode_ns", "record_ns"):
        rows[name] = 8_000
    for tick, count in plan.skips.items():
        rows["skipped_count"][number == tick] = count
    for tick, late in plan.late_us.items():
        at = number == tick
        rows["end_mono_ns"][at] = rows["deadline_mono_ns"][at] + PERIOD_NS + late * 1000
        rows["flags"][at] = records.TICK_FLAG_MISS
    return rows


def _frames(plan: Plan, tick: np.ndarray):
    """One protected VALVE_COMMAND_1 in every tick that is not silent."""
    number = tick["tick"].astype(np.int64)
    speaking = number[~((number >= plan.silent[0]) & (number <= plan.silent[1]))]
    percent = valve_percent(speaking * 1e-3)
    rx = records.allocate(records.CAN_FRAME, len(speaking))
    for k, at in enumerate(speaking.tolist()):
        control = status.CONTROL_RESET if at in plan.resets else status.CONTROL_ACTIVE
        stamp = at * 1000
        frame = contract.command_frame(
            1, control=control, setpoint_percent=float(percent[k]), timestamp_us=stamp, counter=k % 16
        )
        if at in plan.damaged:
            frame[0] ^= 0x5A
        rx["data"][k] = np.frombuffer(bytes(frame), np.uint8)
    rx["tick"] = speaking
    rx["can_id"] = 0x201
    rx["length"] = 8
    rx["mono_ns"] = START_MONO_NS + speaking * PERIOD_NS + 30_000
    rx["kernel_real_ns"] = START_REAL_NS + speaking * PERIOD_NS - 200_000
    rx["status"] = np.where(np.isin(speaking, plan.damaged), status.FRAME_BAD_CRC, status.FRAME_VALID)
    tick["frames_received"] = np.isin(number, speaking)
    frames = np.zeros((len(rx), 72), np.uint8)
    frames[:, 0], frames[:, 1], frames[:, 4] = 0x01, 0x02, 8
    frames[:, 8:16] = rx["data"]
    first = np.append(np.searchsorted(speaking, number), len(speaking)).astype(np.int64)
    return rx, frames, np.full(len(rx), 16, np.int64), first


def _misses(plan: Plan, number: np.ndarray):
    late = sorted(plan.late_us)
    miss = records.allocate(records.MISS, len(late))
    miss["tick"] = late
    miss["lateness_ns"] = [plan.late_us[tick] * 1000 for tick in late]
    miss["cause"] = status.CAUSE_PREEMPTED
    known = np.searchsorted(np.array(late), number).astype(np.int64)
    forced = np.zeros(len(number), np.int64)
    for tick in late:
        if plan.late_us[tick] > 5000:
            forced[np.searchsorted(number, tick) + 1] = 1
    return miss, known, forced


def _write(path, arrays, metadata, attachments, axis: str) -> None:
    writer = LogWriter(path, [axis], 8, metadata, attachments)
    for start in range(0, len(arrays["tick"]), 500):
        rows = slice(start, start + 500)
        tick = arrays["tick"][rows]
        writer.write_ticks(tick, arrays["command"][rows], arrays["state"][rows], START_MONO_NS, START_REAL_NS)
        for name, write in (
            ("can", lambda part: writer.write_can(part, START_MONO_NS, START_REAL_NS)),
            ("miss", lambda part: writer.write_miss(part, START_REAL_NS, PERIOD_NS)),
        ):
            part = arrays[name]
            write(part[(part["tick"] >= tick["tick"][0]) & (part["tick"] <= tick["tick"][-1])])
        writer.flush()
    closing = {
        "exit_reason": status.EXIT_NAMES[status.EXIT_DURATION],
        "start_mono_ns": START_MONO_NS,
        "start_real_ns": START_REAL_NS,
    }
    writer.close({"run": {**metadata["run"], **closing}})
