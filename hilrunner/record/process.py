"""The recorder process: ring in, log out, until the runner ends or dies.

It ignores SIGINT, SIGTERM and SIGHUP: only the end of the runner ends it, so that the log is finished in every case.
"""

import contextlib
import json
import os
import resource
import select
import signal
import sys
import time

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.errors import HilrunnerError
from hilrunner.record import config as recorder_config
from hilrunner.record.drain import Drain
from hilrunner.record.launch import READY_OPEN, READY_REFUSED, attach_ring
from hilrunner.record.mcap_log import LOG_LEVEL_ERROR, LOG_LEVEL_INFO, LOG_LEVEL_WARNING, LogWriter
from hilrunner.record.statistics import HISTOGRAM_ATTACHMENT, frame_counts, histogram_text, statistics_record

CYCLE_MS = 50
FLUSH_INTERVAL_NS = 1_000_000_000


class Watch:
    """Tells when the runner has ended, by its word or by its death."""

    def __init__(self, parent_pid: int) -> None:
        self._poll = select.poll()
        self._fd = -1
        self.died = False
        with contextlib.suppress(ProcessLookupError):
            self._fd = os.pidfd_open(parent_pid)
            self._poll.register(self._fd, select.POLLIN)
        # a runner that died before the descriptor was opened has handed us to another parent
        if self._fd < 0 or os.getppid() != parent_pid:
            self.died = True

    def wait(self, timeout_ms: int) -> None:
        """Sleep, or wake at once when the runner dies."""
        if not self.died and self._poll.poll(timeout_ms):
            self.died = True


class Recorder:
    """Everything that takes records, in one place: log, cross-check, statistics, live view."""

    def __init__(self, settings: recorder_config.RecorderConfig, drain: Drain, log: LogWriter | None) -> None:
        self.settings = settings
        self.drain = drain
        self.ring = drain.ring
        self.log = log
        self.tick_count = 0
        self.last_tick = -1
        self._dropped_ticks = 0
        self._lost_bytes = 0

    @property
    def start_mono_ns(self) -> int:
        """CLOCK_MONOTONIC of tick 0."""
        return self.drain.word(ring_layout.WORD_START_MONO_NS)

    @property
    def start_real_ns(self) -> int:
        """CLOCK_REALTIME of tick 0, by the run's one offset."""
        return self.drain.word(ring_layout.WORD_START_REAL_NS)

    def take_ticks(self, tick: np.ndarray, command: np.ndarray, state: np.ndarray) -> None:
        """Whole periods, in order."""
        self.tick_count += len(tick)
        self.last_tick = int(tick["tick"][-1])
        if self.log:
            self.log.write_ticks(tick, command, state, self.start_mono_ns, self.start_real_ns)

    def take_misses(self, miss: np.ndarray) -> None:
        """Missed deadlines, in order."""
        if self.log:
            self.log.write_miss(miss, self.start_real_ns, self.settings.period_ns)

    def take_frames(self, can: np.ndarray) -> None:
        """CAN frames, in order."""
        if self.log:
            self.log.write_can(can, self.start_mono_ns, self.start_real_ns)

    def write_statistics(self) -> None:
        """The loop's histograms so far."""
        if self.log and self.tick_count:
            real_ns = self.start_real_ns + self.last_tick * self.settings.period_ns
            record = statistics_record(self.ring, self.last_tick, self.tick_count)
            self.log.write_statistics(record, real_ns + self.settings.period_ns, real_ns)

    def event(self, level: int, text: str) -> None:
        """A line in /log."""
        if self.log:
            self.log.write_log(level, "recorder", text, time.time_ns())

    def account(self) -> None:
        """Tell of ticks the ring dropped and bytes the disk refused since the last call."""
        dropped = self.drain.dropped().ticks
        if dropped > self._dropped_ticks:
            self.event(
                LOG_LEVEL_ERROR,
                f"ring full: {dropped - self._dropped_ticks} ticks dropped near tick {self.last_tick}, {dropped} in all",
            )
            self._dropped_ticks = dropped
        if self.log and self.log.lost_bytes > self._lost_bytes:
            self.drain.store(ring_layout.WORD_RECORDER_LOST_BYTES, self.log.lost_bytes)
            self.event(LOG_LEVEL_ERROR, f"disk refused {self.log.lost_bytes} bytes ({self.log.lost_messages} messages)")
            self._lost_bytes = self.log.lost_bytes


def run(settings: recorder_config.RecorderConfig, recorder: Recorder, watch: Watch) -> int:
    """Drain until the runner ends; returns its exit reason (status.EXIT_*)."""
    drain = recorder.drain
    statistics_interval_ns = int(1e9 / settings.statistics_hz)
    next_flush_ns = time.monotonic_ns() + FLUSH_INTERVAL_NS
    next_statistics_ns = time.monotonic_ns() + statistics_interval_ns
    while True:
        # the end is read before the counts: what the counts say then is final
        reason = drain.word(ring_layout.WORD_EXIT_REASON)
        ended = watch.died or reason != status.EXIT_RUNNING
        counts = drain.snapshot()
        if not ended:
            watch.wait(CYCLE_MS)
        drain.consume(counts, recorder)
        now_ns = time.monotonic_ns()
        if ended or now_ns >= next_statistics_ns:
            next_statistics_ns = now_ns + statistics_interval_ns
            recorder.write_statistics()
        if ended:
            return reason if reason != status.EXIT_RUNNING else status.EXIT_KILLED
        if now_ns >= next_flush_ns:
            next_flush_ns = now_ns + FLUSH_INTERVAL_NS
            recorder.account()
            if recorder.log:
                recorder.log.flush()


def summarise(recorder: Recorder, reason: int, begin_mono_ns: int) -> dict:
    """What the runner is told at the end; see docs/log.md."""
    log = recorder.log
    usage = resource.getrusage(resource.RUSAGE_SELF)
    wall_s = (time.monotonic_ns() - begin_mono_ns) * 1e-9
    dropped = recorder.drain.dropped()
    return {
        "log_path": str(log.path) if log else None,
        "exit_reason": status.EXIT_NAMES[reason],
        "tick_count": recorder.tick_count,
        "last_tick": recorder.last_tick,
        "messages": log.message_counts() if log else {},
        "size_bytes": log.size_bytes if log else 0,
        "lost_bytes": log.lost_bytes if log else 0,
        "lost_messages": log.lost_messages if log else 0,
        "dropped_ticks": dropped.ticks,
        "dropped_misses": dropped.misses,
        "dropped_frames": dropped.frames,
        "ring_fill_ratio_max": round(recorder.drain.fill_ratio_max, 6),
        "write_stall_ns_max": log.write_stall_ns_max if log else 0,
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 3),
        "cpu_ratio": round((usage.ru_utime + usage.ru_stime) / max(wall_s, 1e-9), 4),
        "memory_bytes_max": usage.ru_maxrss * 1024,
        "frames": frame_counts(recorder.ring, recorder.settings.axis_names),
        "error": None,
    }


def closing_metadata(recorder: Recorder, reason: int) -> dict[str, dict[str, str]]:
    """The `run` table again, now with how it ended."""
    dropped = recorder.drain.dropped()
    ended = {
        "exit_reason": status.EXIT_NAMES[reason],
        "exit_reason_code": reason,
        "start_mono_ns": recorder.start_mono_ns,
        "start_real_ns": recorder.start_real_ns,
        "clock_offset_ns": recorder.start_real_ns - recorder.start_mono_ns,
        "tick_count": recorder.tick_count,
        "dropped_ticks": dropped.ticks,
        "dropped_misses": dropped.misses,
        "dropped_frames": dropped.frames,
        "lost_bytes": recorder.log.lost_bytes if recorder.log else 0,
        "lost_messages": recorder.log.lost_messages if recorder.log else 0,
    }
    return {
        "run": {**recorder.settings.metadata.get("run", {}), **{key: str(value) for key, value in ended.items()}},
        "frames": frame_counts(recorder.ring, recorder.settings.axis_names),
    }


def leave_realtime(cpus: list[int] | None) -> None:
    """Ordinary scheduling on the cores given: what the runner was granted must not be inherited."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    if cpus:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, cpus)


def open_log(settings: recorder_config.RecorderConfig) -> LogWriter | None:
    """The log of this run, or None when none is wanted."""
    if settings.log_path is None:
        return None
    attachments = []
    for one in settings.attachments:
        if one.path is not None:
            with open(one.path, "rb") as file:
                data = file.read()
        else:
            data = (one.text or "").encode()
        attachments.append((one.name, one.media_type, data))
    shape = ring_layout.RingShape(*settings.ring_shape)
    return LogWriter(settings.log_path, settings.axis_names, shape.can_data_size, settings.metadata, attachments)


def main() -> int:
    """Entry of `python -m hilrunner.record`; exit code 0 when the log was finished."""
    begin_mono_ns = time.monotonic_ns()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    text = sys.stdin.read()
    if not text:
        return 0  # the runner died before it said anything: there is nothing to record
    settings = recorder_config.decode(text)
    leave_realtime(settings.cpus)
    shape = ring_layout.RingShape(*settings.ring_shape)
    block, ring = attach_ring(settings.ring_fd, shape)
    drain = Drain(ring, shape)
    watch = Watch(settings.parent_pid)
    try:
        log = open_log(settings)
    except (HilrunnerError, OSError) as error:
        parts = [error.place, error.problem, error.limit, error.remedy] if isinstance(error, HilrunnerError) else None
        report({"error": parts or ["recorder", str(error), "", ""]})
        drain.store(ring_layout.WORD_RECORDER_READY, READY_REFUSED)
        return 2
    recorder = Recorder(settings, drain, log)
    drain.store(ring_layout.WORD_RECORDER_READY, READY_OPEN)
    reason = run(settings, recorder, watch)
    recorder.event(
        LOG_LEVEL_WARNING if reason == status.EXIT_KILLED else LOG_LEVEL_INFO,
        f"run ended: {status.EXIT_NAMES[reason]}; last tick {recorder.last_tick}",
    )
    if log:
        log.flush()
        recorder.account()
        log.add_attachment(HISTOGRAM_ATTACHMENT, "application/json", histogram_text(ring).encode())
        log.close(closing_metadata(recorder, reason))
        drain.store(ring_layout.WORD_RECORDER_LOST_BYTES, log.lost_bytes)
    report(summarise(recorder, reason, begin_mono_ns))
    return 0


def report(summary: dict) -> None:
    """One JSON line for the runner; nobody reads it when the runner is dead."""
    with contextlib.suppress(OSError):
        sys.stdout.write(json.dumps(summary) + "\n")
        sys.stdout.flush()
