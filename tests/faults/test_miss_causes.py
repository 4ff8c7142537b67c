"""Each cause of a miss is provoked on the real loop and found named: page fault, competing task, burst, recorder, plant step.

The loop runs on a core of its own in real time; a provocation lasts several periods, so that it makes a miss on any machine. What
else makes ticks late here does not matter: the provoked miss has to be among them, with its part and its cause.
"""

import contextlib
import dataclasses
import os
import signal
import socket
import threading
import time

import msgspec
import numpy as np
import pytest

from hilrunner.base import records, status
from hilrunner.base import ring as ring_layout
from hilrunner.base.compiled import entry
from hilrunner.evidence.reader import read_run
from hilrunner.realtime.clock import make_clock, now_mono_ns
from hilrunner.realtime.loop import NO_BUS, run_loop
from hilrunner.realtime.miss import open_schedstat
from hilrunner.record import launch
from hilrunner.record.config import RecorderConfig
from hilrunner.setup.arm import arm, local_ring, ring_shape
from hilrunner.setup.axes import build_axes
from hilrunner.setup.profile import LoadedProfile, parse_profile
from tests.faults.slow_page import SlowPage

PERIOD_NS = 2_000_000
PERIODS_LOST = 15
DELAY_S = PERIODS_LOST * PERIOD_NS * 1e-9
ATTEMPTS = 5
BURSTS_MAX = 50
MAPPED_FRAMES = 20_000
PROFILE = """
name = "miss-causes"
[bench]
period_us = 2000
warm_up_ticks = 20
[[axis]]
name = "luffing"
position_range_mm = [500.0, 700.0]
[axis.load]
kind = "constant"
force_kn = 600.0
[crosscheck]
enabled = false
"""


@entry
def spin_until(clock, until_mono_ns):
    """Keep the core busy."""
    while now_mono_ns(clock) < until_mono_ns:
        pass


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    path = tmp_path_factory.mktemp("profile") / "miss-causes.toml"
    loaded = LoadedProfile(profile=parse_profile(PROFILE, str(path)), path=path, text=PROFILE)
    spin_until(make_clock(0), 0)
    return loaded, build_axes(loaded, status.ENGINE_REFERENCE)


class Runner:
    """The loop on a thread and core of its own, with a schedstat descriptor, until `stop`."""

    def __init__(self, parts, ring=None, descriptor=NO_BUS, overrun=None, **replaced) -> None:
        loaded, axes = parts
        self.ring = local_ring(ring_shape(loaded)) if ring is None else ring
        armed = arm(loaded, axes, self.ring, record=True, overrun=overrun)
        self.bench = armed.bench._replace(**replaced)
        self.descriptor = descriptor
        self.cpu = max(os.sched_getaffinity(0))
        self.fifo = False
        self._ready = threading.Event()
        run_loop(self.bench, NO_BUS, 0, 0)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._ready.wait()

    def _run(self) -> None:
        os.sched_setaffinity(0, {self.cpu})
        self.fifo = _ask_for(os.SCHED_FIFO, 10)
        if not self.fifo:  # without rights the lowest class stands in: everyone else goes first
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        self.bench.config[0]["schedstat_fd"] = open_schedstat()
        start_mono_ns = time.monotonic_ns() + 5 * PERIOD_NS
        ring = self.ring.header
        ring[ring_layout.WORD_START_MONO_NS * ring_layout.HEADER_STRIDE] = start_mono_ns
        ring[ring_layout.WORD_START_REAL_NS * ring_layout.HEADER_STRIDE] = time.time_ns()
        self._ready.set()
        run_loop(self.bench, self.descriptor, start_mono_ns, 1 << 40)
        os.close(int(self.bench.config[0]["schedstat_fd"]))

    @property
    def tick_count(self) -> int:
        return int(self.bench.progress[0]["tick_count"])

    def wait_ticks(self, count: int) -> None:
        """Until `count` more ticks have run."""
        wanted = self.tick_count + count
        while self.tick_count < wanted:
            time.sleep(0.002)

    def stop(self) -> None:
        self.ring.header[ring_layout.WORD_STOP_REQUEST * ring_layout.HEADER_STRIDE] = 1
        self.join()

    def join(self) -> None:
        self._thread.join()

    def misses(self) -> np.ndarray:
        """records.MISS of the local ring, which nobody empties."""
        count = min(ring_layout.word(self.ring, ring_layout.WORD_MISS_WRITTEN), len(self.ring.miss))
        return self.ring.miss[:count]

    def take_misses(self) -> np.ndarray:
        """records.MISS told since the last call; makes room for more of them."""
        header, step = self.ring.header, ring_layout.HEADER_STRIDE
        first, end = (int(header[word * step]) for word in (ring_layout.WORD_MISS_READ, ring_layout.WORD_MISS_WRITTEN))
        taken = self.ring.miss[np.arange(first, end) % len(self.ring.miss)].copy()
        header[ring_layout.WORD_MISS_READ * step] = end
        return taken


def _ask_for(policy: int, priority: int) -> bool:
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except PermissionError:
        return False
    return True


@contextlib.contextmanager
def running(parts, **options):
    runner = Runner(parts, **options)
    try:
        runner.wait_ticks(40)
        yield runner
    finally:
        runner.stop()


def _told(misses: np.ndarray) -> set[tuple[str, str]]:
    phases = {records.PHASE_WAKE: "wake", **dict(enumerate(status.PHASE_NAMES))}
    return {(phases[int(row["phase"])], status.CAUSE_NAMES[row["cause"]]) for row in misses}


def test_a_page_fault_is_named(parts):
    with SlowPage(DELAY_S) as page, running(parts, phase_ns=page.array[: status.PHASE_COUNT]) as runner:
        for _ in range(ATTEMPTS):
            page.forget()
            runner.wait_ticks(10)
    # the durations are written between sending and recording
    wanted = ("record", "page fault")
    assert wanted in _told(runner.misses())
    fault = next(row for row in runner.misses() if row["cause"] == status.CAUSE_PAGE_FAULT)
    assert fault["page_faults_minor"] + fault["page_faults_major"] >= 1
    assert fault["lateness_ns"] >= (PERIODS_LOST - 2) * PERIOD_NS
    assert page.faults >= ATTEMPTS


def _compete(cpu: int, fifo: bool) -> None:
    os.sched_setaffinity(0, {cpu})
    if fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    spin_until(make_clock(0), time.monotonic_ns() + PERIODS_LOST * PERIOD_NS)


def test_a_competing_task_is_named(parts):
    with running(parts) as runner:
        for _ in range(ATTEMPTS):
            rival = threading.Thread(target=_compete, args=(runner.cpu, runner.fifo))
            rival.start()
            rival.join()
            runner.wait_ticks(5)
    named = [row for row in runner.misses() if row["cause"] == status.CAUSE_PREEMPTED]
    assert named, _told(runner.misses())
    assert max(int(row["lateness_ns"]) for row in named) > PERIOD_NS


def test_a_burst_of_a_thousand_frames_is_named(parts):
    """A bus of many mapped identifiers, each of which is compared with every frame, makes a burst last several periods."""
    loaded, axes = parts
    table = arm(loaded, axes, local_ring(ring_shape(loaded)), record=True).bench.command_table
    frames = np.tile(table.frames, MAPPED_FRAMES // len(table.frames))
    frames.flags.writeable = False  # as the table's own: another type would compile the loop again
    large = table._replace(frames=frames)
    bus = Bursts()
    with contextlib.closing(bus), running(parts, descriptor=bus.descriptor, command_table=large) as runner:
        told, bursts = set(), []
        for _ in range(BURSTS_MAX):  # another task may take the core for most of a burst, which then is the cause
            bus.burst()
            runner.wait_ticks(20)
            misses = runner.take_misses()
            told |= _told(misses)
            bursts = [row for row in misses if row["cause"] == status.CAUSE_FRAME_BURST]
            if bursts:
                break
    assert bursts, told
    # 1000, or as many as a socket buffer holds where a larger one is not allowed
    assert all(256 <= int(row["frames_queued"]) <= 1000 for row in bursts)
    assert {int(row["phase"]) for row in bursts} <= {status.PHASE_RECEIVE, status.PHASE_DECODE, status.PHASE_RECORD}


class Bursts:
    """A bus that is silent but for bursts: behind one descriptor, each burst is a socket of its own that was filled before."""

    def __init__(self) -> None:
        self._ours, self._theirs = self._pair()
        self.descriptor = self._ours.fileno()

    @staticmethod
    def _pair():
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)
        for end in (ours, theirs):
            end.setblocking(False)
        return ours, theirs

    def burst(self) -> None:
        """A thousand frames wait at once: never in parts, as they would if they were sent while the loop receives."""
        full, theirs = self._pair()
        with full:
            with contextlib.suppress(BlockingIOError):
                for _ in range(1000):
                    theirs.send(b"\x55\x05" + bytes(14))
            os.dup2(full.fileno(), self.descriptor)
        self._theirs.close()
        self._theirs = theirs

    def close(self) -> None:
        self._ours.close()
        self._theirs.close()


def _with_substeps(axes, count: int):
    return dataclasses.replace(axes, plants=[dataclasses.replace(plant, substep_count=count) for plant in axes.plants])


def test_a_plant_step_too_long_for_its_period_is_named(parts):
    loaded, built = parts
    runner = Runner((loaded, _with_substeps(built, 40_000)), overrun="catch-up")
    runner.wait_ticks(40)
    runner.stop()
    # the first late ticks are in the warm-up: by tick 20 most of the lateness comes from before
    told = _told(runner.misses())
    assert ("wake", "carried over from the tick before") in told
    assert ("wake", "late wake-up (kernel or hypervisor)") not in told


def test_the_first_tick_of_a_slow_plant_names_the_step(parts):
    loaded, built = parts
    started_late = _without_warm_up(loaded)
    runner = Runner((started_late, _with_substeps(built, 40_000)), overrun="stop")
    runner.join()  # the first miss ends the run
    assert len(runner.misses()) == 1
    assert int(runner.misses()[0]["execution_ns"]) > PERIOD_NS
    assert int(runner.misses()[0]["phase"]) == status.PHASE_STEP
    assert status.CAUSE_NAMES[int(runner.misses()[0]["cause"])] in ("plant step", "preempted by another task")


def _without_warm_up(loaded):
    bench = msgspec.structs.replace(loaded.profile.bench, warm_up_ticks=0)
    return msgspec.structs.replace(loaded, profile=msgspec.structs.replace(loaded.profile, bench=bench))


def test_a_stopped_recorder_is_named_in_the_log_it_finishes(parts, tmp_path):
    loaded, _ = parts
    shape = ring_shape(loaded)._replace(tick_capacity=64)
    block, ring = launch.create_ring(shape)
    settings = RecorderConfig(
        ring_fd=block.fd,
        ring_shape=list(shape),
        axis_names=["luffing"],
        period_ns=PERIOD_NS,
        parent_pid=os.getpid(),
        log_path=str(tmp_path / "run.mcap"),
    )
    recorder = launch.start_recorder(settings, ring)
    recorder.wait_ready()
    try:
        with running(parts, ring=ring) as runner:
            os.kill(recorder.process.pid, signal.SIGSTOP)
            runner.wait_ticks(64 + 60)  # the ring is full, and some more are lost
            os.kill(recorder.process.pid, signal.SIGCONT)
            runner.wait_ticks(40)
    finally:
        os.kill(recorder.process.pid, signal.SIGCONT)
        ring.header[ring_layout.WORD_EXIT_REASON * ring_layout.HEADER_STRIDE] = status.EXIT_SIGNAL
        summary = recorder.finish()
        block.close()
    run = read_run(tmp_path / "run.mcap")
    assert summary["dropped_ticks"] >= 50
    lost = [row for row in run.miss if row["cause"] == status.CAUSE_RECORDER]
    assert len(lost) >= 50
    assert all(row["phase"] == status.PHASE_RECORD for row in lost)
    assert summary["dropped_ticks"] + len(run.tick) == runner.tick_count + int(
        runner.bench.progress[0]["skipped_count"]
    )
