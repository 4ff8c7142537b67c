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
from hilrunner.realtime import loop, waiting  # noqa: E402
from hilrunner.realtime.clock import WORD_FAKE  # noqa: E402
from hilrunner.setup import axes  # noqa: E402
from hilrunner.setup.arm import arm, local_ring, ring_shape  # noqa: E402
from hilrunner.setup.profile import load_profile  # noqa: E402

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

    def __init__(self, steps=None, wakes=None, receive=None, send=None, flags=None, stop_at=None, rehearsals=None):
        self.steps = steps or {}
        self.wakes = wakes or {}
        self.receive = receive or {}
        self.send = send or {}
        self.flags = flags or {}
        self.stop_at = stop_at
        self.rehearsals = rehearsals or {}  # tick -> how long its rehearsal takes, ns
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

    def current(bench_tick_table):
        return lambda descriptor, box, *rest: bench_tick_table.get(len(world.ran), 0)

    loop.now_mono_ns = loop.now_real_ns = loop.anchor = now
    waiting.now_mono_ns = now
    waiting.wait_until = waiting.sleep_until = wait
    waiting.spin_until = spin
    waiting.rehearse = rehearse
    loop.step_stage = step
    loop.encode_stage = lambda bench, tick: 0 if not world.send else 1
    loop.receive_frames = current(world.receive)
    loop.send_frames = lambda descriptor, box, count: world.send.get(len(world.ran) - 1, count)
    loop.read_usage = lambda *arguments: None


def run(
    world: World, ticks: int, overrun="skip", warm_up=0, more="", descriptor=-1, stimulus=None, spin_ns=0, rehearse=True
) -> dict:
    """One scenario; what happened, as plain numbers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(PROFILE.format(overrun=overrun, warm_up=warm_up, more=more, rehearse=str(rehearse).lower()))
        loaded = load_profile(str(path))
        shape = ring_shape(loaded, 0.1)
        ring = local_ring(shape)
        armed = arm(loaded, axes_of(loaded), ring, record=True, stimulus=stimulus, spin_ns=spin_ns)
    bench = armed.bench
    bench.clock[WORD_NOW] = START_NS - 500_000
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
        "miss_ticks": ring.miss["tick"][:missed].tolist(),
        "miss_lateness": ring.miss["lateness_ns"][:missed].tolist(),
        "late_samples": int(ring.extreme[wake, 3]),
        "late_max": int(ring.extreme[wake, 1]),
        "dropped": ring_layout.word(ring, ring_layout.WORD_TICK_DROPPED),
    }


def limit(name: str, most: int, action: str) -> str:
    return f'[deadline.{name}]\nmax = {most}\naction = "{action}"\n'


LATE = {3: 1_100_000}  # tick 3 takes 0.1 ms more than its period
STALL = {3: 3_400_000}  # tick 3 takes 3.4 periods

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
    "ring_full": lambda: run(World(), 300),
}

if __name__ == "__main__":
    print(json.dumps({name: scenario() for name, scenario in SCENARIOS.items()}))
