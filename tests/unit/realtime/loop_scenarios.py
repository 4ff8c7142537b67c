"""The loop on a simulated clock, interpreted; `test_loop_timing.py` runs this once and judges what it prints.

    NUMBA_DISABLE_JIT=1 python tests/unit/realtime/loop_scenarios.py      one JSON object: scenario -> what happened

The clock is a number in the clock array; a read costs 10 ns, waiting jumps to the deadline (plus a planned lateness), a plant step
takes as long as the scenario says. Nothing here reads a real clock.
"""

import json
import os
import tempfile
from pathlib import Path

assert os.environ.get("NUMBA_DISABLE_JIT") == "1", "the simulated clock replaces compiled functions"

import numpy as np  # noqa: E402

from hilrunner.base import records, status  # noqa: E402
from hilrunner.base import ring as ring_layout  # noqa: E402
from hilrunner.realtime import late, loop, recording, waiting  # noqa: E402
from hilrunner.realtime.clock import WORD_FAKE  # noqa: E402
from hilrunner.setup import axes  # noqa: E402
from hilrunner.setup.arm import arm, local_ring, ring_shape  # noqa: E402
from hilrunner.setup.profile import load_profile  # noqa: E402
from tests.tools.contract import command_frame  # noqa: E402

START_NS = 1_000_000_000
PERIOD_NS = 1_000_000
READ_COST_NS = 10
EVEN = dict.fromkeys(
    range(12), 40_000
)  # a step a tick; a rehearsal takes what the tick before took, if not told otherwise
WORD_NOW = WORD_FAKE  # word of the clock array that holds the simulated time

PROFILE = """
name = "scenario"
[bench]
period_us = 1000
warm_up_ticks = {warm_up}
overrun = "{overrun}"
rehearse = {rehearse}
[[axis]]
name = "luffing"
[axis.load]
kind = "constant"
force_kn = 600.0
[crosscheck]
enabled = false
{more}
"""


_AXES = []
axes.stored_substep_count = lambda plant, period_s: (
    14
)  # the plant never steps here; its stability takes minutes uncompiled


def axes_of(loaded):
    """The axes of the scenario profile; the plant itself never steps here."""
    if not _AXES:
        _AXES.append(axes.build_axes(loaded, status.ENGINE_REFERENCE))
    return _AXES[0]


class World:
    """What the scenario plans: durations of steps, lateness of wake-ups, errors of the bus, all by tick."""

    def __init__(
        self, steps=None, wakes=None, receive=None, send=None, flags=None, stop_at=None, rehearsals=None, traffic=None,
        receives=None,
    ):  # fmt: skip
        self.steps = steps or {}
        self.wakes = wakes or {}
        self.receive = receive or {}
        self.send = send or {}
        self.flags = flags or {}
        self.stop_at = stop_at
        self.rehearsals = rehearsals or {}  # tick -> how long its rehearsal takes, ns
        self.traffic = traffic
        self.receives = receives or {}  # ticks that ran before -> how long the call for frames takes, ns
        self.rehearsed = []  # (tick, ns before its deadline at the start, at the end)
        self.ran = []  # (tick, periods advanced, start of the step on the simulated clock)


def bind(world: World) -> None:
    """Put the simulated clock, bus and plant in place of the real ones."""

    def now(clock):
        clock[WORD_NOW] += READ_COST_NS
        return int(clock[WORD_NOW])

    def wait(clock, deadline_ns):
        tick = -((START_NS - deadline_ns) // PERIOD_NS)  # the tick a spin tail belongs to
        clock[WORD_NOW] = max(clock[WORD_NOW], deadline_ns + world.wakes.get(int(tick), 0))

    def spin(clock, until_ns):
        clock[WORD_NOW] = max(clock[WORD_NOW], until_ns)

    def rehearse(bench, shadow, descriptor, tick):
        deadline_ns = START_NS + tick * PERIOD_NS
        begin_ns = int(bench.clock[WORD_NOW])
        bench.clock[WORD_NOW] += world.rehearsals.get(int(tick), world.steps.get(int(tick) - 1, 0))
        world.rehearsed.append((int(tick), int(deadline_ns) - begin_ns, int(deadline_ns) - int(bench.clock[WORD_NOW])))

    def step(bench, tick, periods):
        world.ran.append((int(tick), int(periods), int(bench.clock[WORD_NOW])))
        bench.clock[WORD_NOW] += world.steps.get(int(tick), 0)
        if world.stop_at == tick:
            bench.ring.header[ring_layout.WORD_STOP_REQUEST * ring_layout.HEADER_STRIDE] = 1
        return np.int64(world.flags.get(int(tick), 0))

    def receive(descriptor, box, first):
        world.clock[WORD_NOW] += world.receives.pop(len(world.ran), 0)
        if world.traffic is not None:
            return world.traffic.receive(box, first, int(world.clock[WORD_NOW]))
        return world.receive.get(len(world.ran), 0)

    def real(clock):
        return now(clock) + (world.traffic.offset_ns(int(clock[WORD_NOW])) if world.traffic else 0)

    loop.now_mono_ns = loop.anchor = late.now_mono_ns = recording.now_mono_ns = waiting.now_mono_ns = now
    loop.now_real_ns = real
    loop.clock_offset_ns = late.clock_offset_ns = lambda clock: real(clock) - int(clock[WORD_NOW])
    waiting.wait_until = waiting.sleep_until = wait
    waiting.spin_until = spin
    waiting.rehearse = rehearse
    loop.step_stage = late.step_stage = step
    loop.encode_stage = lambda bench, tick: 0 if not world.send else 1
    loop.receive_frames = late.receive_frames = receive
    loop.send_frames = lambda descriptor, box, count: world.send.get(len(world.ran) - 1, count)
    loop.read_usage = lambda *arguments: None


def run(
    world: World, ticks: int, overrun="skip", warm_up=0, more="", descriptor=-1, stimulus=None, spin_ns=0, rehearse=True,
    ring_s=0.1,
) -> dict:  # fmt: skip
    """One scenario; what happened, as plain numbers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(PROFILE.format(overrun=overrun, warm_up=warm_up, more=more, rehearse=str(rehearse).lower()))
        loaded = load_profile(str(path))
        shape = ring_shape(loaded, ring_s)
        ring = local_ring(shape)
        armed = arm(loaded, axes_of(loaded), ring, record=True, stimulus=stimulus, spin_ns=spin_ns)
    bench = armed.bench
    bench.clock[WORD_NOW] = START_NS - 500_000
    world.clock = bench.clock
    bind(world)
    reason = loop.run_loop(bench, descriptor, START_NS, ticks)
    progress = bench.progress[0]
    written = ring_layout.word(ring, ring_layout.WORD_TICK_WRITTEN)
    missed = ring_layout.word(ring, ring_layout.WORD_MISS_WRITTEN)
    wake = records.HISTOGRAM_NAMES.index("wake_lateness")
    return {
        "reason": int(reason),
        "ran": world.ran,
        "rehearsed": world.rehearsed,
        "miss_count": int(progress["miss_count"]),
        "skipped_count": int(progress["skipped_count"]),
        "warned_count": int(progress["warned_count"]),
        "bus_errno": int(progress["bus_errno"]),
        "frames_unsent": int(progress["frames_unsent"]),
        "mode": int(bench.commands[0]["mode"]),
        "deadlines": ring.tick["deadline_mono_ns"][:written].tolist(),
        "wakes": ring.tick["wake_mono_ns"][:written].tolist(),
        "tick_flags": ring.tick["flags"][:written].tolist(),
        "rows": ring.tick["tick"][:written].tolist(),
        "frames_of_rows": ring.tick["frames_received"][:written].tolist(),
        "skipped_of_rows": ring.tick["skipped_count"][:written].tolist(),
        "ages": ring.command["age_ns"][:written].tolist(),
        "frame_ticks": _received(ring)["tick"].tolist(),
        "frame_stamps": _received(ring)["kernel_real_ns"].tolist(),
        "frame_statuses": _received(ring)["status"].tolist(),
        "response_max": int(ring.extreme[records.HISTOGRAM_NAMES.index("response"), 1]),
        "responses": int(ring.extreme[records.HISTOGRAM_NAMES.index("response"), 3]),
        "stalls": [ring_layout.word(ring, word) for word in STALL_WORDS],
        "miss_ticks": ring.miss["tick"][:missed].tolist(),
        "miss_lateness": ring.miss["lateness_ns"][:missed].tolist(),
        "late_samples": int(ring.extreme[wake, 3]),
        "late_max": int(ring.extreme[wake, 1]),
        "dropped": ring_layout.word(ring, ring_layout.WORD_TICK_DROPPED),
    }


STALL_WORDS = (
    ring_layout.WORD_STALL_COUNT, ring_layout.WORD_STALL_NS_MAX, ring_layout.WORD_STALL_TICK_FIRST, ring_layout.WORD_STALL_NS_LAST,
)  # fmt: skip


def _received(ring) -> np.ndarray:
    written = ring_layout.word(ring, ring_layout.WORD_CAN_WRITTEN)
    rows = ring.can[:written]
    return rows[(rows["flags"] & records.CAN_FRAME_SENT) == 0]


class Traffic:
    """Commands of a firmware that never stops, one every `every_ns` from before tick 0 on, in a socket whose kernel stamps them.

    Args:
        sets: (time, ns, by which the wall clock is set then) pairs. stamped: the socket gives stamps.
    """

    def __init__(self, every_ns=5_000_000, sets=(), stamped=True, until_ns=START_NS + 1_000_000_000, phase_ns=-300_000):
        self.sets, self.stamped = sets, stamped
        times = range(START_NS + phase_ns, until_ns, every_ns)
        self.waiting = [(time_ns, self._frame(k)) for k, time_ns in enumerate(times)]
        self.sent = [time_ns for time_ns, _ in self.waiting]

    def _frame(self, k):
        data = bytes(command_frame(1, control=status.CONTROL_ACTIVE, setpoint_percent=30.0, counter=k % 16))
        return np.frombuffer((0x201).to_bytes(4, "little") + bytes([8, 0, 0, 0]) + data, np.uint8)

    def offset_ns(self, now_ns):
        return WALL_NS + sum(by_ns for at_ns, by_ns in self.sets if now_ns >= at_ns)

    def receive(self, box, first, now_ns):
        """As receive_frames: what has come by now, as much as finds room."""
        count = first
        while count < box.frame.shape[0] and self.waiting and self.waiting[0][0] <= now_ns:
            time_ns, frame = self.waiting.pop(0)
            box.frame[count, :16] = frame
            box.size_bytes[count] = 16
            box.kernel_real_ns[count] = time_ns + self.offset_ns(time_ns) if self.stamped else 0
            count += 1
        return count


def limit(name: str, most: int, action: str) -> str:
    return f'[deadline.{name}]\nmax = {most}\naction = "{action}"\n'


LATE = {3: 1_100_000}  # tick 3 takes 0.1 ms more than its period
STALL = {3: 3_400_000}  # tick 3 takes 3.4 periods
WALL_NS = 1_700_000_000_000_000_000  # CLOCK_REALTIME - CLOCK_MONOTONIC
ASLEEP = {20: 150_000_000}  # the host stands still while the loop waits for tick 20
AT_WORK = {20: 150_000_000}  # the same in the middle of tick 20
HOUR_NS = 3_600_000_000_000


def stalled(overrun="skip", ticks=300, more="", stimulus=None, period_of_firmware_ns=5_000_000, **world) -> dict:
    """A run with a firmware that never stops sending."""
    traffic = Traffic(period_of_firmware_ns, **world.pop("traffic", {}))
    return run(
        World(traffic=traffic, send={-1: 0}, **world),
        ticks,
        overrun=overrun,
        more=more,
        descriptor=9,
        stimulus=stimulus,
        ring_s=0.5,
    )


SCENARIOS = {
    "on_time": lambda: run(World(), 8),
    "late_a_little": lambda: run(World(steps=LATE), 8),
    "stall_skip": lambda: run(World(steps=STALL), 10),
    "stall_catch_up": lambda: run(World(steps=STALL), 10, overrun="catch-up"),
    "stall_stop": lambda: run(World(steps=STALL), 10, overrun="stop"),
    "late_wake": lambda: run(World(wakes={4: 250_000}), 8),
    "warm_up": lambda: run(World(steps={1: 1_500_000}), 8, warm_up=3),
    "total_stop": lambda: run(
        World(steps={2: 1_100_000, 4: 1_100_000, 6: 1_100_000}), 12, more=limit("total_misses", 1, "stop")
    ),
    "total_warn": lambda: run(
        World(steps={2: 1_100_000, 4: 1_100_000, 6: 1_100_000}), 12, more=limit("total_misses", 1, "warn")
    ),
    "consecutive_spread": lambda: run(
        World(steps={2: 1_100_000, 5: 1_100_000, 8: 1_100_000}), 12, more=limit("consecutive_misses", 1, "stop")
    ),
    "consecutive_stop": lambda: run(
        World(steps={2: 1_100_000, 3: 1_100_000, 4: 1_100_000}), 12, more=limit("consecutive_misses", 1, "stop")
    ),
    "lateness_fail_safe": lambda: run(World(steps=STALL), 12, more=limit("lateness_us", 1000, "fail-safe")),
    "lateness_below": lambda: run(World(steps=LATE), 12, more=limit("lateness_us", 1000, "stop")),
    "receive_lost": lambda: run(World(receive={5: -100}), 12, descriptor=9),
    "send_lost": lambda: run(World(send={6: -19}), 12, descriptor=9),
    "send_full": lambda: run(World(send={6: 0, 7: 0}), 12, descriptor=9),
    "not_finite": lambda: run(World(flags={4: status.FLAG_NOT_FINITE}), 12),
    "stop_request": lambda: run(World(stop_at=5), 1000),
    "stimulus_end": lambda: run(World(), 1000, stimulus=np.zeros((7, 1))),
    "no_ticks": lambda: run(World(), 0),
    "rehearsed_asleep": lambda: run(World(steps=EVEN), 12),
    "rehearsal_longer_than_the_tick": lambda: run(World(steps=EVEN, rehearsals={1: 180_000}), 12, spin_ns=200_000),
    "rehearsed": lambda: run(World(steps=EVEN), 12, spin_ns=200_000),
    "rehearsal_held_up": lambda: run(World(steps=EVEN, rehearsals={4: 500_000}), 12, spin_ns=200_000),
    "rehearsal_too_long": lambda: run(World(steps=EVEN), 12, spin_ns=50_000),
    "rehearsal_not_worth_it": lambda: run(World(steps=dict.fromkeys(range(6), 110_000)), 6),
    "rehearsal_off": lambda: run(World(steps=EVEN), 6, rehearse=False, spin_ns=200_000),
    "rehearsal_woken_late": lambda: run(World(steps=EVEN, wakes={6: 170_000}), 12, spin_ns=200_000),
    "asleep": lambda: stalled(wakes=ASLEEP),
    "asleep_unstamped": lambda: stalled(wakes=ASLEEP, traffic={"stamped": False}),
    "asleep_catch_up": lambda: stalled(wakes=ASLEEP, overrun="catch-up"),
    "at_work": lambda: stalled(steps=AT_WORK),
    "at_work_catch_up": lambda: stalled(steps=AT_WORK, overrun="catch-up"),
    "on_the_way_to_its_frames": lambda: stalled(receives={20: 150_000_000}),
    "at_the_start": lambda: stalled(wakes={0: 150_000_000}),
    "over_the_end": lambda: stalled(wakes={100: 150_000_000}, ticks=120),
    "over_the_end_at_work": lambda: stalled(steps={100: 150_000_000}, ticks=120),
    "in_the_last_tick": lambda: stalled(wakes={119: 150_000_000}, ticks=120),
    "over_the_end_of_a_stimulus": lambda: stalled(wakes={20: 150_000_000}, stimulus=np.zeros((60, 1))),
    "over_the_end_catch_up": lambda: stalled(wakes={100: 150_000_000}, ticks=120, overrun="catch-up"),
    "asleep_and_set_forward": lambda: stalled(wakes=ASLEEP, traffic={"sets": ((START_NS + 100_000_000, HOUR_NS),)}),
    "asleep_and_set_back": lambda: stalled(wakes=ASLEEP, traffic={"sets": ((START_NS + 100_000_000, -HOUR_NS),)}),
    "set_forward": lambda: stalled(traffic={"sets": ((START_NS + 102_000_000, HOUR_NS),)}),
    "set_back": lambda: stalled(traffic={"sets": ((START_NS + 102_000_000, -HOUR_NS),)}),
    "stop_in_a_stall": lambda: stalled(steps=AT_WORK, stop_at=20),
    "more_frames_than_the_inbox": lambda: stalled(wakes=ASLEEP, period_of_firmware_ns=100_000),
    "stall_warn": lambda: stalled(wakes=ASLEEP, more=limit("stall_ms", 100, "warn")),
    "stall_ends_the_run": lambda: stalled(wakes=ASLEEP, more=limit("stall_ms", 100, "stop")),
    "stall_allowed": lambda: stalled(wakes=ASLEEP, more=limit("stall_ms", 200, "stop")),
    "lateness_of_a_stall": lambda: stalled(wakes=ASLEEP, more=limit("lateness_us", 100_000, "stop")),
    "ring_full": lambda: run(World(), 300),
}

if __name__ == "__main__":
    print(json.dumps({name: scenario() for name, scenario in SCENARIOS.items()}))
