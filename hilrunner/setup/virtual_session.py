"""One run in virtual time, from profile to closed log: start the firmware, run the same three stages, record in this process.

The log, the cross-check and what a run tells at its end are those of a run on a bus: the same recorder takes the same records. Only the clock is
another one, and nothing is asked of the host: no rights, no bus, no recorder process that must keep up. Time waits for the recorder.
"""

import contextlib
import os
import shlex
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.errors import HilrunnerError, UsageError
from hilrunner.base.units import NS_PER_S
from hilrunner.realtime.virtual import CALL_ADVANCE, CALL_COUNT, CALL_HUB, CALL_RECEIVE, CALL_SEND, run_virtual
from hilrunner.record.check_worker import CheckWorker
from hilrunner.record.config import RecorderConfig
from hilrunner.record.drain import Drain
from hilrunner.record.process import open_live, open_log
from hilrunner.record.recorder import Recorder
from hilrunner.setup.arm import Armed, arm, local_ring, ring_shape
from hilrunner.setup.axes import AxisSet, build_axes, period_ns
from hilrunner.setup.parcel import pack
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.session import RunOptions, RunResult, Session
from hilrunner.virtual.world import START_MONO_NS, START_REAL_NS, Firmware, FirmwareEnd, VirtualBus, World

MODE = "virtual time"
_BLOCK_TICKS = 1_000  # run without a look at signals or the recorder
_BACKLOG_TICKS = 50_000  # ticks that the cross-check may be behind before time waits for it
_FOREVER = 1 << 62


@dataclass(frozen=True)
class VirtualOptions:
    """What virtual time is made of: its buses, the first of which is the bench's, and its firmware."""

    buses: tuple[VirtualBus, ...] = (VirtualBus(),)
    firmware: tuple[Firmware, ...] = field(default_factory=tuple)


def virtual_options(loaded: LoadedProfile, command: Sequence[str], bus_name: str | None) -> VirtualOptions:
    """What the command line and the profile ask for: the command line's firmware goes before the profile's.

    Raises:
        UsageError: neither names a firmware; or the profile comes out of a log, whose programs are not run.
    """
    if loaded.profile.firmware and not command and loaded.sealed is not None:
        raise UsageError(
            "--virtual",
            "the profile comes out of a log, and a program that a log names is not run",
            remedy=f"if you trust it, name it yourself after --: {shlex.join(loaded.profile.firmware[0].command)}",
        )
    listed = [Firmware(one.command, one.environment) for one in loaded.profile.firmware]
    firmware = [Firmware(tuple(command))] if command else listed
    if not firmware:
        raise UsageError(
            "--virtual",
            "no firmware to run",
            remedy="name its command after --, or in the profile as [[firmware]] command",
        )
    can = loaded.profile.can
    bit_rate = can.bitrate if loaded.profile.virtual.bus == "timed" else 0
    bus = VirtualBus(bus_name or "vcan0", fd=True, bitrate=bit_rate)
    return VirtualOptions(buses=(bus,), firmware=tuple(firmware))


class VirtualSession(Session):
    """One run; `start`, then `running` until False, then `finish`, as a Session on a bus."""

    def __init__(
        self,
        loaded: LoadedProfile,
        options: RunOptions,
        virtual: VirtualOptions,
        begin_mono_ns: int | None = None,
        make_log: Callable[[RecorderConfig], Any] = open_log,
    ) -> None:
        """Args: make_log: gives the log, None, or what takes records in place of a log, as record.process.main has it."""
        super().__init__(loaded, options, begin_mono_ns)
        self.virtual = virtual
        self._make_log = make_log
        self.ends: list[FirmwareEnd] = []
        self.failure = ""
        self._error: BaseException | None = None
        self._drain: Drain
        self._recorder: Recorder

    def _prepare(self) -> None:
        if self._is_recorded():
            models = self.options.engine != status.ENGINE_REFERENCE
            self._parcel = pack(self.loaded, self.options.engine, models=models)
            self.loaded = self._parcel.loaded
        self.world = World(self.virtual.buses, self.virtual.firmware)
        self.axes: AxisSet = build_axes(self.loaded, self.options.engine)
        shape = ring_shape(self.loaded)
        self.ring = local_ring(shape)
        self.armed: Armed = arm(self.loaded, self.axes, self.ring, record=True, stimulus=self.options.stimulus)
        if self._parcel is not None:
            self._parcel.check_unchanged()
        self._calls = _calls(self.world)
        run_virtual(self.armed.bench, self._calls, START_MONO_NS, 0, 0)  # compiled or loaded before the firmware starts
        self._log_is_ours |= self.options.log_path is not None and not os.path.lexists(self.options.log_path)
        settings = self._recorder_config(shape)
        self._drain = Drain(self.ring, shape)
        self._recorder = Recorder(settings, self._drain, self._make_log(settings), live=open_live(settings))
        self._log_is_ours = self.options.log_path is not None
        if settings.check is not None:
            self._recorder.check = CheckWorker(settings.check, settings.axis_names, settings.period_ns)
        self.start_mono_ns = START_MONO_NS
        self._store(ring_layout.WORD_PERIOD_NS, period_ns(self.loaded))
        self._store(ring_layout.WORD_START_MONO_NS, START_MONO_NS)
        self._store(ring_layout.WORD_START_REAL_NS, START_REAL_NS)
        self.world.start()
        self._started_mono_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name="hilrunner-virtual", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """The loop's thread: blocks of ticks, each taken by the recorder."""
        self._go.wait()
        if self._cancelled:
            return
        try:
            self.exit_reason = self._run_blocks()
            self.failure = self.world.failure()
        except BaseException as error:
            self._error = error
            self.exit_reason = status.EXIT_FIRMWARE
        finally:
            with contextlib.suppress(HilrunnerError, OSError):
                self.ends = self.world.stop()

    def _run_blocks(self) -> int:
        limit = _FOREVER
        if self.options.duration_s is not None:
            limit = int(round(self.options.duration_s * NS_PER_S / period_ns(self.loaded)))
        ticks_a_second = NS_PER_S // period_ns(self.loaded)
        progress = self.armed.bench.progress[0]
        tick, told_tick = 0, 0
        while tick < limit:
            reason = run_virtual(self.armed.bench, self._calls, START_MONO_NS, tick, min(tick + _BLOCK_TICKS, limit))
            tick = int(progress["tick"]) + 1 if progress["tick_count"] else 0
            self._record()
            if tick - told_tick >= ticks_a_second:
                told_tick = tick
                self._recorder.write_statistics()
            if reason != status.EXIT_RUNNING:
                return reason
        return status.EXIT_DURATION

    def _record(self) -> None:
        """Everything that the block has left in the ring; waits where the cross-check is far behind."""
        self._drain.consume(self._drain.snapshot(), self._recorder)
        self._recorder.collect_check()
        check = self._recorder.check
        while check is not None and not check.error and check.backlog_ticks > _BACKLOG_TICKS:
            time.sleep(0.005)
            self._recorder.collect_check()

    def _await_check(self) -> None:
        """Time has ended, so nothing is lost by waiting until the cross-check has seen every tick."""
        check = self._recorder.check
        while check is not None and not check.error and check.backlog_ticks > 0:
            time.sleep(0.01)
            self._recorder.collect_check()

    def finish(self) -> RunResult:
        """After the last tick: close the log, collect what is known."""
        self._thread.join()
        if self._error is not None:
            self.world.close()
            raise self._error
        self._store(ring_layout.WORD_EXIT_REASON, self.exit_reason)
        self._store(ring_layout.WORD_KERNEL_DROPPED, self.world.frames_dropped)
        self._record()
        self._recorder.write_statistics()
        self._await_check()
        self._recorder.finish(self.exit_reason)
        summary = self._recorder.summary(self.exit_reason)
        self.world.close()
        return RunResult(
            exit_reason=self.exit_reason,
            armed=self.armed,
            ring=self.ring,
            recorder=summary,
            grants=[],
            host_report=None,
            mode=MODE,
            start_up_s=(self._started_mono_ns - self.begin_mono_ns) / NS_PER_S,
            bus_error=self.failure,
            has_stimulus=self.options.stimulus is not None,
            stimulus_facts=self.options.stimulus_facts,
            log_path=self.options.log_path,
            firmware=self.ends,
        )

    def _abandon(self) -> None:
        if self.world is not None:
            self.world.close()
        super()._abandon()

    def _metadata(self, files: list) -> dict:
        tables = super()._metadata(files)
        tables["host"] = {"mode_label": MODE}
        tables["run"] |= {
            f"firmware_{index}": shlex.join(one.command) for index, one in enumerate(self.virtual.firmware)
        }
        return tables


def _calls(world: World) -> np.ndarray:
    """What realtime.virtual calls."""
    calls = np.zeros(CALL_COUNT, np.int64)
    addresses = world.addresses
    calls[CALL_HUB] = world.hub
    calls[CALL_ADVANCE], calls[CALL_RECEIVE], calls[CALL_SEND] = (
        addresses["advance"],
        addresses["receive"],
        addresses["send"],
    )
    return calls
