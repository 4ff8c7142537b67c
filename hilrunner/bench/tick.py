"""The full tick as a thing to be measured: an armed bench on a socketpair, its peer, its recorder, its own real-time thread.

Everything is what `hilrunner run` uses (setup.arm, realtime.loop, the recorder process); only the bus is a socketpair, so that
it also runs where there is no CAN. Slices start from the same state each time and are told apart in the histograms.
"""

import contextlib
import os
import queue
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import msgspec
import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.records import HISTOGRAM_NAMES
from hilrunner.base.units import NS_PER_S, NS_PER_US
from hilrunner.bench.peer import WORD_RECEIVED, WORD_SENT, Peer, command_frames, socket_pair
from hilrunner.realtime.clock import WORD_SPIN_NS
from hilrunner.realtime.loop import NO_BUS, run_loop
from hilrunner.realtime.miss import open_schedstat
from hilrunner.record import launch
from hilrunner.record.config import RecorderConfig
from hilrunner.setup import host, resources
from hilrunner.setup.arm import arm, local_ring, ring_shape
from hilrunner.setup.axes import AxisSet, build_axes
from hilrunner.setup.profile import LoadedProfile, load_profile
from hilrunner.setup.signals import AxisMapping, default_mapping

VALVE_PERCENT = 20.0
_START_DELAY_NS = 5_000_000
_WARM_UP_TICKS = 100
# What the next period needs; put back before every slice.
_STATE_FIELDS = (
    "state",
    "commands",
    "last_counter",
    "input",
    "group_tick",
    "sent_counter",
    "progress",
    "quantity",
    "load_scale",
    "state_flags",
)


@dataclass(frozen=True)
class Place:
    """Where to measure: the loop's core, the core of everything else, and the priority."""

    cpu: int
    other_cpu: int
    priority: int


@dataclass(frozen=True)
class Slice:
    """What one slice of ticks showed; warm-up ticks are in none of it but `ticks`."""

    histogram: np.ndarray  # int64[H, BUCKET_COUNT]
    extreme: np.ndarray  # int64[H, 4]; of the slice
    ticks: int
    misses: int
    skipped: int
    dropped: int
    frames_received: int
    frames_sent: int
    peer_sent: int
    processor_ns: int  # of the loop's thread, in the kernel too
    state: np.ndarray  # float64[axis, STATE_SIZE] at the end

    def of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Histogram row and extreme row by name (records.HISTOGRAM_NAMES)."""
        index = HISTOGRAM_NAMES.index(name)
        return self.histogram[index], self.extreme[index]


def profile_with(profile: str, axis_count: int, period_us: int, folder: Path) -> LoadedProfile:
    """The profile with its first axis repeated, another period, and the shipped contract with all messages every period."""
    loaded = load_profile(profile)
    first = loaded.profile.axis[0]
    axes = tuple(msgspec.structs.replace(first, name=f"axis{k + 1}") for k in range(axis_count))
    can = msgspec.structs.replace(
        loaded.profile.can, dbc=str(_dbc_with(axis_count, folder)), mapping=_every_period(axis_count, period_us)
    )
    bench = msgspec.structs.replace(loaded.profile.bench, period_us=period_us, warm_up_ticks=_WARM_UP_TICKS)
    changed = msgspec.structs.replace(loaded.profile, axis=axes, bench=bench, can=can, fault=())
    return LoadedProfile(profile=changed, path=loaded.path, text=loaded.text)


def _every_period(axis_count: int, period_us: int) -> tuple[AxisMapping, ...]:
    """The shipped mapping, every measurement in every period: one frame in and three out an axis and tick."""
    return tuple(
        msgspec.structs.replace(
            axis,
            measurements=[msgspec.structs.replace(one, cycle_ms=period_us / 1000) for one in axis.measurements],
        )
        for axis in default_mapping(axis_count)
    )


def _generator():
    """firmware_iface/make_axes.py, which belongs to the firmware's folder and is no module of ours."""
    spec = spec_from_file_location("hilrunner_make_axes", resources.firmware_interface_folder() / "make_axes.py")
    generator = module_from_spec(spec)
    spec.loader.exec_module(generator)
    return generator


def _dbc_with(axis_count: int, folder: Path) -> Path:
    """The shipped DBC grown to `axis_count` axes by its own generator."""
    path = folder / f"actuator-{axis_count}.dbc"
    text = (resources.firmware_interface_folder() / "actuator.dbc").read_text()
    path.write_text(_generator().with_axes(text, axis_count))
    return path


def axis_count_max() -> int:
    """Most axes the shipped DBC's identifiers and Data IDs can carry."""
    return _generator().AXIS_COUNT_MAX


def build_one_axis(profile: str, period_us: int, engine: int) -> AxisSet:
    """Plant, wave and initial state of a profile's first axis, for one or many benches of this period."""
    loaded = load_profile(profile)
    bench = msgspec.structs.replace(loaded.profile.bench, period_us=period_us)
    changed = msgspec.structs.replace(loaded.profile, axis=loaded.profile.axis[:1], bench=bench)
    return build_axes(LoadedProfile(profile=changed, path=loaded.path, text=loaded.text), engine)


def _repeated(one: AxisSet, axis_count: int) -> AxisSet:
    """`axis_count` axes like the only one of `one`: what is built and checked once need not be again."""
    return AxisSet(
        plants=one.plants * axis_count,
        waves=one.waves * axis_count,
        initial_states=np.repeat(one.initial_states, axis_count, axis=0),
        model_reports=one.model_reports,
    )


class TickBench:
    """An armed bench; use as a context manager, `run` slices inside."""

    def __init__(
        self,
        place: Place,
        profile: str = "amc-lift",
        *,
        axis_count: int = 1,
        period_us: int = 1000,
        engine: int = status.ENGINE_SURROGATE,
        record: bool = True,
        axes: AxisSet | None = None,
    ) -> None:
        self.place = place
        self.period_ns = period_us * NS_PER_US
        self._stack = contextlib.ExitStack()
        self._record = record
        self.folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="hilrunner-bench-")))
        self.log_path = self.folder / "bench.mcap"
        self._axis_count = axis_count
        self.loaded = profile_with(profile, axis_count, period_us, self.folder)
        self._axes = axes or build_one_axis(profile, period_us, engine)
        self.grants: list[host.Grant] = []
        self.recorder_summary: dict = {}

    def __enter__(self) -> "TickBench":
        shape = ring_shape(self.loaded)
        if self._record:
            self._block, self.ring = launch.create_ring(shape)
            self._stack.callback(self._block.close)
            self._recorder = launch.start_recorder(self._recorder_config(shape), self.ring)
            self._recorder.wait_ready()
        else:
            self.ring = local_ring(shape)
        self.armed = arm(self.loaded, _repeated(self._axes, self._axis_count), self.ring, record=self._record)
        self._before = {name: getattr(self.armed.bench, name).copy() for name in _STATE_FIELDS}
        self._loop_end, peer_end = socket_pair()
        self._stack.callback(self._loop_end.close)
        self._stack.callback(peer_end.close)
        frames = command_frames(str(self.armed.dbc_path), self.armed.bench.command_table, VALVE_PERCENT)
        self.peer = Peer(peer_end, frames, self.place.other_cpu)
        self.peer.warm()
        run_loop(self.armed.bench, NO_BUS, 0, 0)
        self._thread = RealtimeThread(self.place)
        self.grants = self._thread.grants
        self.armed.bench.config[0]["schedstat_fd"] = self._thread.call(open_schedstat)
        return self

    def __exit__(self, *_error) -> None:
        fd = int(self.armed.bench.config[0]["schedstat_fd"])
        if fd >= 0:
            os.close(fd)
        self._thread.close()
        self.finish_log()
        self._stack.close()

    def finish_log(self) -> None:
        """End the recorder; its summary is known from here on, and the log is whole until the block ends."""
        if self._record:
            self._store(ring_layout.WORD_EXIT_REASON, status.EXIT_DURATION)
            self.recorder_summary = self._recorder.finish()

    @property
    def recorder_pid(self) -> int:
        """Process id of the recorder."""
        return self._recorder.process.pid

    def run(self, slice_s: float, *, spin_ns: int = 0, rehearse: bool = True, flat_out: bool = False) -> Slice:
        """One slice of about `slice_s` after the warm-up ticks, from the state after arming.

        With `flat_out` the grid lies wholly in the past and every tick is caught up: no sleep, as fast as it goes.
        """
        bench = self.armed.bench
        for name, values in self._before.items():
            getattr(bench, name)[...] = values
        bench.clock[WORD_SPIN_NS] = spin_ns
        bench.config[0]["rehearse"] = int(rehearse)
        bench.config[0]["overrun"] = status.OVERRUN_CATCH_UP if flat_out else status.OVERRUN_SKIP
        self.peer.drain()
        with contextlib.suppress(BlockingIOError):
            while self._loop_end.recv(128):
                pass
        histogram = self.ring.histogram.copy()
        dropped = ring_layout.word(self.ring, ring_layout.WORD_TICK_DROPPED)
        self.ring.extreme[...] = 0  # of this slice; the recorder only reads them
        ticks = _WARM_UP_TICKS + max(1, int(slice_s * NS_PER_S / self.period_ns))
        start_mono_ns = time.monotonic_ns() + (-ticks * self.period_ns if flat_out else _START_DELAY_NS)
        self._store(ring_layout.WORD_PERIOD_NS, self.period_ns)
        self._store(ring_layout.WORD_START_REAL_NS, start_mono_ns + time.time_ns() - time.monotonic_ns())
        self._store(ring_layout.WORD_START_MONO_NS, start_mono_ns)
        self.peer.start(max(start_mono_ns, time.monotonic_ns()), self.period_ns)
        try:
            processor_ns = self._thread.call(lambda: self._timed_loop(start_mono_ns, ticks))
        finally:
            self.peer.stop()
        return self._slice(histogram, dropped, processor_ns)

    def _timed_loop(self, start_mono_ns: int, ticks: int) -> int:
        """The loop; the processor time it took, ns."""
        before_ns = time.thread_time_ns()
        run_loop(self.armed.bench, self._loop_end.fileno(), start_mono_ns, ticks)
        return time.thread_time_ns() - before_ns

    def _slice(self, histogram_before: np.ndarray, dropped_before: int, processor_ns: int) -> Slice:
        progress = self.armed.bench.progress[0]
        return Slice(
            histogram=self.ring.histogram - histogram_before,
            extreme=self.ring.extreme.copy(),
            ticks=int(progress["tick_count"]),
            misses=int(progress["miss_count"]),
            skipped=int(progress["skipped_count"]),
            dropped=ring_layout.word(self.ring, ring_layout.WORD_TICK_DROPPED) - dropped_before,
            frames_received=int(progress["frames_received"]),
            frames_sent=int(progress["frames_sent"]),
            peer_sent=int(self.peer.words[WORD_SENT]),
            processor_ns=processor_ns,
            state=self.armed.bench.state.copy(),
        )

    @property
    def peer_received(self) -> int:
        """Frames the peer took in the last slice."""
        return int(self.peer.words[WORD_RECEIVED])

    def _store(self, word: int, value: int) -> None:
        self.ring.header[word * ring_layout.HEADER_STRIDE] = value

    def _recorder_config(self, shape: ring_layout.RingShape) -> RecorderConfig:
        return RecorderConfig(
            ring_fd=self._block.fd,
            ring_shape=list(shape),
            axis_names=[axis.name for axis in self.loaded.profile.axis],
            period_ns=self.period_ns,
            parent_pid=os.getpid(),
            log_path=str(self.log_path),
            cpus=[self.place.other_cpu],
        )


class RealtimeThread:
    """A thread with every right a run asks for, that makes calls for others: the loop's own conditions."""

    def __init__(self, place: Place) -> None:
        self._calls: queue.SimpleQueue = queue.SimpleQueue()
        self._answers: queue.SimpleQueue = queue.SimpleQueue()
        self._options = host.RealtimeOptions(priority=place.priority, cpu=place.cpu)
        self.grants: list[host.Grant] = []
        self._thread = threading.Thread(target=self._serve, name="bench-loop", daemon=True)
        self._thread.start()
        self.grants = self.call(lambda: host.enter_realtime(self._options))

    def call(self, function: Callable[[], object]):
        """Run a function there; its result, or its error."""
        self._calls.put(function)
        result, error = self._answers.get()
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """Give the rights back and end."""
        self.call(lambda: host.leave_realtime(self.grants))
        self._calls.put(None)
        self._thread.join()

    def _serve(self) -> None:
        while (function := self._calls.get()) is not None:
            try:
                self._answers.put((function(), None))
            except BaseException as error:  # whatever it is, the caller shall see it
                self._answers.put((None, error))


def choose_place(cpu: int, priority: int) -> Place:
    """The loop's core (−1: the best there is) and another one for the rest, the same if there is only one."""
    from hilrunner.setup.host_cpu import suggest_cpu
    from hilrunner.setup.host_words import HostFiles

    allowed = os.sched_getaffinity(0)
    chosen = cpu if cpu >= 0 else suggest_cpu(HostFiles(), allowed)
    others = allowed - {chosen}
    return Place(chosen, min(others) if others else chosen, priority)


def say(text: str) -> None:
    """Progress for a person: one line on standard error, never in the results."""
    if sys.stderr.isatty():
        print(f"bench: {text}", file=sys.stderr, flush=True)
