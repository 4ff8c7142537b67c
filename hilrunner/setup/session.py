"""One run from profile to closed log: open the bus, start the recorder, arm, ask for real time, run the loop, end cleanly.

The loop runs on a thread of its own that never needs the interpreter; this thread only watches: signals, the live line, the
recorder. Order matters: rights asked for while the plants are built, recorder and arming side by side, clock last.
"""

import os
import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.base.plain_text import plain_line
from hilrunner.base.units import M_PER_MM, NS_PER_S, PA_PER_MPA
from hilrunner.realtime.clock import CALL_NAMES, CALL_SHIFT, WORD_FAILURE
from hilrunner.realtime.loop import NO_BUS, run_loop
from hilrunner.realtime.miss import open_schedstat
from hilrunner.record import launch
from hilrunner.record.config import Attachment, CheckConfig, RecorderConfig
from hilrunner.record.drain import Drain
from hilrunner.record.file_lock import is_locked
from hilrunner.record.run_watch import RunWatch
from hilrunner.setup import host
from hilrunner.setup.arm import Armed, arm, local_ring, ring_shape
from hilrunner.setup.axes import AxisSet, build_axes, period_ns, reference_plants
from hilrunner.setup.bus import OpenBus, drain_stale_frames, errno_text, lost_before_start, open_bus
from hilrunner.setup.contract import sent_signal_names
from hilrunner.setup.parcel import Parcel, pack
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.run_manifest import run_files, run_metadata
from hilrunner.setup.stimulus_facts import StimulusFacts
from hilrunner.virtual.world import FirmwareEnd, World

_START_DELAY_NS = 20_000_000  # from "everything is ready" to the deadline of tick 0
_FOREVER = 1 << 62
_RECORDER_WAIT_S = 50.0  # without any progress: short of what a hang is
_TALLY_MODULE = (
    "hilrunner.evidence.tally_process"  # takes the records of a run that keeps no log, and judges its limits
)


@dataclass(frozen=True)
class RunOptions:
    """What the command line asks for."""

    engine: int = status.ENGINE_SURROGATE
    interface: str = "socketcan"
    channel: str | None = None  # None: no bus, a stimulus drives the run
    bitrate: int | None = None
    fd: bool = False
    bus_options: dict[str, Any] = field(default_factory=dict)  # arguments of the python-can backend
    duration_s: float | None = None
    log_path: Path | None = None  # None: no log
    log_is_new: bool = False  # log_path is an empty file that was made for this run
    stimulus: np.ndarray | None = None
    stimulus_facts: StimulusFacts | None = None  # how it was understood
    live_port: int | None = None
    require_realtime: bool = False
    realtime: host.RealtimeOptions = field(default_factory=host.RealtimeOptions)


@dataclass
class RunResult:
    """What is known when a run has ended."""

    exit_reason: int
    armed: Armed
    ring: ring_layout.Ring
    recorder: dict  # the recorder's summary; empty without one
    grants: list
    host_report: object
    mode: str
    start_up_s: float  # from the call to the deadline of tick 0
    bus_error: str = ""
    has_stimulus: bool = False  # commands came from a stimulus, not from a firmware
    log_path: Path | None = None
    stimulus_facts: StimulusFacts | None = None
    firmware: Sequence[FirmwareEnd] = ()  # of a run in virtual time


class Session:
    """One run; `start`, then `running` until False, then `finish`."""

    def __init__(self, loaded: LoadedProfile, options: RunOptions, begin_mono_ns: int | None = None) -> None:
        self.loaded = loaded
        self.options = options
        self.begin_mono_ns = time.monotonic_ns() if begin_mono_ns is None else begin_mono_ns
        self.bus: OpenBus | None = None
        self.world: World | None = None  # of a run in virtual time
        self.recorder: launch.RecorderHandle | None = None
        self.grants: list = []
        self.host_report: host.HostReport | None = None
        self.exit_reason = status.EXIT_RUNNING
        self.start_mono_ns = 0
        self.axes: AxisSet
        self.armed: Armed
        self.ring: ring_layout.Ring
        self._block: launch.RingBlock | None = None
        self._parcel: Parcel | None = None  # what the log will hold; the bench is built from it
        self._go = threading.Event()
        self._rights_known = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self._cancelled = False
        self._log_is_ours = options.log_is_new  # nobody's file before: made for this run, or emptied by its recorder
        self.schedstat_fd = -1
        self._run_watch: RunWatch | None = None
        self._lacks_told: list[str] = []

    def start(self) -> None:
        """Everything before tick 0, then let the clock run; raises HilrunnerError with nothing left behind."""
        try:
            self._prepare()
            self._go.set()
        except BaseException:  # an interrupt as well: it is raised only until the clock runs (stop_early)
            self._abandon()
            raise

    def _prepare(self) -> None:
        options = self.options
        if self._is_recorded():
            self._parcel = pack(self.loaded, options.engine, models=options.engine != status.ENGINE_REFERENCE)
            self.loaded = self._parcel.loaded
        if options.channel is not None:
            self.bus = open_bus(options.interface, options.channel, options.bitrate, options.fd, options.bus_options)
        shape = ring_shape(self.loaded)
        if options.live_port is None and not self._is_recorded() and not self.loaded.profile.crosscheck.enabled:
            self.ring = local_ring(shape)
        else:
            self._block, self.ring = launch.create_ring(shape)
        self._thread = threading.Thread(target=self._run, name="hilrunner-loop", daemon=True)
        self._thread.start()
        self.axes = build_axes(
            self.loaded, options.engine
        )  # while the thread asks for its rights and tries its wake-ups
        self._rights_known.wait()
        if self._failure is not None:
            raise self._failure
        if options.require_realtime:
            host.require_realtime(self.grants, self.host_report.findings)
        if self._block is not None:
            self._log_is_ours |= options.log_path is not None and not os.path.lexists(options.log_path)
            self.recorder = launch.start_recorder(self._recorder_config(shape), self.ring)
        self.armed = arm(
            self.loaded,
            self.axes,
            self.ring,
            record=self.recorder is not None,
            stimulus=options.stimulus,
            schedstat_fd=self.schedstat_fd,
        )
        if self._parcel is not None:
            self._parcel.check_unchanged()
        # compile (or load from the cache) and page everything in: a loop of no ticks
        run_loop(self.armed.bench, NO_BUS, 0, 0)
        if self.recorder is not None:
            self.recorder.wait_ready(_RECORDER_WAIT_S)
            self._log_is_ours = options.log_path is not None
        self._drain_stale_frames()
        self._run_watch = RunWatch(Drain(self.ring, shape), period_ns(self.loaded))
        self.start_mono_ns = time.monotonic_ns() + _START_DELAY_NS
        self._store(ring_layout.WORD_PERIOD_NS, period_ns(self.loaded))
        self._store(ring_layout.WORD_START_MONO_NS, self.start_mono_ns)
        self._store(ring_layout.WORD_START_REAL_NS, self.start_mono_ns + time.time_ns() - time.monotonic_ns())

    def _is_recorded(self) -> bool:
        """Whether every tick is wanted by a log, or by limits that are judged without one."""
        profile = self.loaded.profile
        return self.options.log_path is not None or bool(profile.limits or profile.requirement)

    def _drain_stale_frames(self) -> None:
        """What arrived while all of this was made ready belongs to no tick; it tells whether another bench is there already."""
        if self.bus is None:
            return
        own_ids = {int(can_id) for can_id in self.armed.bench.measurement_table.can_id}
        try:
            found = drain_stale_frames(self.bus.descriptor, own_ids)
        except OSError as error:
            raise lost_before_start(self.bus.name, error) from None
        if found >= 0:
            raise UsageError(
                self.bus.name,
                f"another bench is on this bus: it sends frames of identifier {found & 0x1FFFFFFF:#x}, as this one would",
                remedy="end the other bench, or give this one another bus or other identifiers (can.mapping)",
            )

    def _run(self) -> None:
        """The loop's thread: ask for rights, wait for the word, run."""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        try:
            self.grants = host.enter_realtime(self.options.realtime)
            self.host_report = host.inspect_host(
                self.options.channel if self.options.interface == "socketcan" else None,
                period_ns=period_ns(self.loaded),
                probe_s=0.1,
            )
            self.schedstat_fd = open_schedstat()
        except BaseException as error:
            self._failure = error
        finally:
            self._rights_known.set()
        self._go.wait()
        if self._cancelled or self._failure is not None:
            host.leave_realtime(self.grants)  # in the same process others go on: a bench test, the next run
            return
        descriptor = self.bus.descriptor if self.bus is not None else NO_BUS
        limit = _FOREVER
        if self.options.duration_s is not None:
            limit = int(round(self.options.duration_s * NS_PER_S / period_ns(self.loaded)))
        try:
            self.exit_reason = int(run_loop(self.armed.bench, descriptor, self.start_mono_ns, limit))
        finally:
            host.leave_realtime(self.grants)

    def running(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` for the loop to end; True while it runs."""
        self._thread.join(timeout_s)
        return self._thread.is_alive()

    def request_stop(self) -> None:
        """End after the current tick; safe in a signal handler."""
        self._store(ring_layout.WORD_STOP_REQUEST, 1)

    def stop_early(self) -> bool:
        """`request_stop` if the clock runs; False when there is nothing to stop yet."""
        if not self._go.is_set():
            return False
        self.request_stop()
        return True

    def finish(self) -> RunResult:
        """After the loop has ended: close bus and log, collect what is known."""
        self._thread.join()
        bus_error = self._bus_error()
        self._store(ring_layout.WORD_EXIT_REASON, self.exit_reason)
        summary = self.recorder.finish(_RECORDER_WAIT_S) if self.recorder is not None else {}
        if self.bus is not None:
            self.bus.close()
        if self._block is not None:
            self._block.close()
        late = int(self.armed.bench.progress[0]["miss_count"])
        return RunResult(
            exit_reason=self.exit_reason,
            armed=self.armed,
            ring=self.ring,
            recorder=summary,
            grants=self.grants,
            host_report=self.host_report,
            mode=host.mode_label(self.grants, self.host_report.findings, late_ticks=late),
            start_up_s=(self.start_mono_ns - self.begin_mono_ns) / NS_PER_S,
            bus_error=bus_error,
            has_stimulus=self.options.stimulus is not None,
            log_path=self.options.log_path,
            stimulus_facts=self.options.stimulus_facts,
        )

    def news(self) -> list[str]:
        """What has befallen run, log and recorder since the last call, in sentences."""
        told = []
        if self._run_watch is not None:
            told += [text for _, text in self._run_watch.news(int(self.armed.bench.progress[0]["tick"]))]
        lacks = ring_layout.log_lacks(self.ring)
        if self.recorder is not None and self.recorder.poll() is not None and self.exit_reason == status.EXIT_RUNNING:
            lacks.append("the recorder has ended: nothing that happens from now on is in the log")
        told += [text for text in lacks if text not in self._lacks_told]
        self._lacks_told += [text for text in lacks if text not in self._lacks_told]
        return told

    def _bus_error(self) -> str:
        failure = int(self.armed.bench.clock[WORD_FAILURE])
        if failure:
            return f"{CALL_NAMES[failure >> CALL_SHIFT]}: {errno_text(failure & ((1 << CALL_SHIFT) - 1))}"
        number = int(self.armed.bench.progress[0]["bus_errno"])
        if number == 0:
            return ""
        if self.bus is not None and self.bus.lost:
            return self.bus.lost
        return errno_text(number)

    def _abandon(self) -> None:
        """Undo a start that failed: no thread, no recorder, no half-written log."""
        self._cancelled = True
        self._go.set()
        if self.recorder is not None:
            self.recorder.process.kill()
            self.recorder.process.wait()
        if self._log_is_ours and not is_locked(self.options.log_path):  # else another run has taken the name meanwhile
            self.options.log_path.unlink(missing_ok=True)
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        if self.bus is not None:
            self.bus.close()

    def _store(self, word: int, value: int) -> None:
        self.ring.header[word * ring_layout.HEADER_STRIDE] = value

    def _recorder_config(self, shape: ring_layout.RingShape) -> RecorderConfig:
        files = [] if self._parcel is None else run_files(self._parcel, self.options.stimulus)
        return RecorderConfig(
            ring_fd=self._block.fd if self._block is not None else -1,
            ring_shape=list(shape),
            axis_names=[axis.name for axis in self.loaded.profile.axis],
            period_ns=period_ns(self.loaded),
            parent_pid=os.getpid(),
            log_path=str(self.options.log_path) if self.options.log_path else None,
            metadata=self._metadata(files),
            attachments=[
                Attachment(one.name, one.media_type, fd=launch.keep_in_memory(one.name, one.data)) for one in files
            ],
            live_port=self.options.live_port,
            sent_signals=sent_signal_names(self.loaded),
            check=self._check_config(),
            module=_TALLY_MODULE if self.options.log_path is None and self._is_recorded() else "hilrunner.record",
        )

    def _metadata(self, files: list) -> dict:
        tables = run_metadata(self.loaded, files, self.options.engine, self.grants, self.host_report)
        if self.options.stimulus_facts is not None:
            facts = self.options.stimulus_facts
            tables["run"] |= {"stimulus": facts.text(), "stimulus_warnings": plain_line("; ".join(facts.warnings))}
        return tables

    def _check_config(self) -> CheckConfig | None:
        rules = self.loaded.profile.crosscheck
        if not rules.enabled:
            return None
        stimulus = self.options.stimulus
        by_axis = None if stimulus is None else np.ascontiguousarray(stimulus.T, np.float64)
        return CheckConfig(
            plants_fd=launch.plants_file(reference_plants(self.loaded, self.options.engine), by_axis),
            initial_states=self.axes.initial_states.tolist(),
            pressure_tolerance_pa=rules.pressure_tolerance_mpa * PA_PER_MPA,
            position_tolerance_m=rules.position_tolerance_mm * M_PER_MM,
            one_step_pressure_tolerance_pa=rules.one_step_pressure_tolerance_mpa * PA_PER_MPA,
            sustained_pressure_tolerance_pa=rules.sustained_pressure_tolerance_mpa * PA_PER_MPA,
            one_step_decimation=rules.every_n_ticks,
            record_decimation=rules.every_n_ticks,
        )
