"""Everything that takes records, in one place: log, cross-check, statistics, live view; and what is told of them."""

import resource
import time

import numpy as np

from hilrunner.base import records, status
from hilrunner.base import ring as ring_layout
from hilrunner.record.check_worker import CheckWorker
from hilrunner.record.config import RecorderConfig
from hilrunner.record.drain import Drain
from hilrunner.record.levels import LOG_LEVEL_ERROR, LOG_LEVEL_INFO, LOG_LEVEL_WARNING
from hilrunner.record.mcap_log import LogWriter
from hilrunner.record.memory import memory_bytes_max
from hilrunner.record.run_watch import RunWatch
from hilrunner.record.statistics import (
    HISTOGRAM_ATTACHMENT,
    clamped_counts,
    frame_counts,
    histogram_text,
    statistics_record,
)

# for the cross-check's backlog, and on a first start for its compilation: what it has not looked at does not pass
CHECK_WAIT_S = 240.0
CHECK_WAIT_ORPHAN_S = 10.0  # when the runner is dead: the log shall be finished soon


class Recorder:
    """One run's consumer of the ring; `log`, `check` and `live` may each be absent."""

    def __init__(
        self,
        settings: RecorderConfig,
        drain: Drain,
        log: LogWriter | None,
        check: CheckWorker | None = None,
        live=None,
    ) -> None:
        self.settings = settings
        self.drain = drain
        self.log = log
        self.check = check
        self.live = live
        self.tick_count = 0  # rows taken, those of skipped periods among them
        self.frame_count = 0
        self.miss_count = 0
        self.skipped_rows = 0
        self.last_tick = -1
        self.begin_mono_ns = time.monotonic_ns()
        self._watch = RunWatch(drain, settings.period_ns)
        self._lost_bytes = 0
        self._check_error_told = False

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
        self.skipped_rows += int(np.count_nonzero(tick["flags"] & records.TICK_FLAG_SKIPPED))
        self.last_tick = int(tick["tick"][-1])
        offset_ns = self.start_real_ns - self.start_mono_ns
        log_real_ns = tick["end_mono_ns"] + offset_ns
        if self.log:
            self.log.write_ticks(tick, command, state, self.start_mono_ns, self.start_real_ns)
        if self.check:
            self.check.take_ticks(tick, command, state, log_real_ns, tick["deadline_mono_ns"] + offset_ns)
        self._show("take_ticks", tick, command, state, log_real_ns)

    def take_misses(self, miss: np.ndarray) -> None:
        """Missed deadlines, in order."""
        self.miss_count += len(miss)
        if self.log:
            self.log.write_miss(miss, self.start_real_ns, self.settings.period_ns)
        end_real_ns = self.start_real_ns + (miss["tick"].astype(np.int64) + 1) * self.settings.period_ns
        self._show("take_misses", miss, end_real_ns + miss["lateness_ns"])

    def take_frames(self, can: np.ndarray) -> None:
        """CAN frames, in order."""
        self.frame_count += len(can)
        if self.log:
            self.log.write_can(can, self.start_mono_ns, self.start_real_ns)

    def collect_check(self) -> None:
        """Bring the cross-check's results into log and ring header, and a divergence into words."""
        if not self.check:
            return
        for result in self.check.results():
            name = self.settings.axis_names[result.axis]
            if self.log:
                self.log.write_check(name, result.check, result.log_real_ns, result.publish_real_ns)
            self._show("take_check", name, result.check, result.log_real_ns)
        self.drain.store(ring_layout.WORD_CHECK_LAG_NS, self.check.lag_ns)
        for failure in self.check.failures():
            before = self.drain.word(ring_layout.WORD_CHECK_FAILED_TICK)
            if before == 0 or failure.tick + 1 < before:
                self.drain.store(ring_layout.WORD_CHECK_FAILED_TICK, failure.tick + 1)
            self.event(LOG_LEVEL_ERROR, failure.text)
        if self.check.error and not self._check_error_told:
            self._check_error_told = True
            self.event(LOG_LEVEL_WARNING, f"cross-check stopped: {self.check.error}")

    def write_statistics(self) -> None:
        """The loop's histograms so far."""
        if not self.tick_count or not (self.log or self.live):
            return
        record = statistics_record(self.drain.ring, self.last_tick, self.tick_count - self.skipped_rows)
        real_ns = self.start_real_ns + self.last_tick * self.settings.period_ns
        if self.log:
            self.log.write_statistics(record, real_ns + self.settings.period_ns, real_ns)
        self._show("take_statistics", record, real_ns + self.settings.period_ns)

    def event(self, level: int, text: str) -> None:
        """A line in /log."""
        if self.log:
            self.log.write_log(level, "recorder", text, time.time_ns())
        self._show("take_event", level, "recorder", text, time.time_ns())

    def _show(self, take: str, *records) -> None:
        """Hand something to the live view; a view that fails is given up, the log goes on."""
        if self.live is None:
            return
        try:
            getattr(self.live, take)(*records)
        except Exception as error:
            self.live = None
            self.event(LOG_LEVEL_WARNING, f"live view stopped: {type(error).__name__}: {error}")

    def account(self) -> None:
        """Tell what has befallen run and log since the last call."""
        for level, text in self._watch.news(self.last_tick):
            self.event(level, text)
        if self.log:
            self._account_log()

    def _account_log(self) -> None:
        lacks = self.drain.word(ring_layout.WORD_LOG_LACKS)
        found = lacks
        if not self.log.is_in_place():
            found |= ring_layout.LOG_LACKS_NAME
        if self.log.lost_bytes > self._lost_bytes:
            found |= ring_layout.LOG_LACKS_DATA
            self._lost_bytes = self.log.lost_bytes
            self.drain.store(ring_layout.WORD_RECORDER_LOST_BYTES, self._lost_bytes)
            self.event(LOG_LEVEL_ERROR, f"disk refused {self._lost_bytes} bytes ({self.log.lost_messages} messages)")
        self.drain.store(ring_layout.WORD_LOG_LACKS, found)
        if found & ~lacks & ring_layout.LOG_LACKS_NAME:
            self.event(LOG_LEVEL_ERROR, ring_layout.LOG_LACKS_TEXTS[0])

    def finish(self, reason: int, error: list[str] | None = None) -> None:
        """Everything after the last record: cross-check worked off, events, histograms, metadata, end of the file.

        `error` (place, problem, limit, remedy) is what stopped the recorder, if not the end of the run.
        """
        killed = reason == status.EXIT_KILLED
        if self.log:
            self.log.flush()  # the run's own records are safe before anything is waited for
        if self.check and not self.check.finish(CHECK_WAIT_ORPHAN_S if killed else CHECK_WAIT_S):
            self.event(LOG_LEVEL_WARNING, f"cross-check unfinished: {self.check.left_out_ticks} ticks left out")
        self.collect_check()
        self.event(
            LOG_LEVEL_WARNING if killed else LOG_LEVEL_INFO,
            f"run ended: {status.EXIT_NAMES[reason]}; last tick {self.last_tick}",
        )
        for name, count in clamped_counts(self.drain.ring, self.settings.sent_signals).items():
            text = f"{name}: {count} values lay outside the signal's range and were sent as its end"
            self.event(LOG_LEVEL_WARNING, text)
        self.account()
        if self.log:
            self.log.flush()
            self._account_log()
            histograms = histogram_text(self.drain.ring).encode()
            self.log.add_attachment(HISTOGRAM_ATTACHMENT, "application/json", histograms)
            self.log.close(self._closing_metadata(reason, error))
            self.drain.store(ring_layout.WORD_RECORDER_LOST_BYTES, self.log.lost_bytes)
        if self.live:
            self.live.close()

    def summary(self, reason: int) -> dict:
        """What the runner is told at the end; see docs/log.md."""
        log = self.log
        usage = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s = usage.ru_utime + usage.ru_stime
        wall_s = (time.monotonic_ns() - self.begin_mono_ns) * 1e-9
        dropped = self.drain.dropped()
        return {
            "log_path": str(log.path) if log and log.path else None,
            "verdict": log.verdict if log else None,
            "exit_reason": status.EXIT_NAMES[reason],
            "tick_count": self.tick_count,
            "last_tick": self.last_tick,
            "messages": log.message_counts() if log else {},
            "size_bytes": log.size_bytes if log else 0,
            "lost_bytes": log.lost_bytes if log else 0,
            "lost_messages": log.lost_messages if log else 0,
            "dropped_ticks": dropped.ticks,
            "dropped_misses": dropped.misses,
            "dropped_frames": dropped.frames,
            "ring_fill_ratio_max": round(self.drain.fill_ratio_max, 6),
            "write_stall_ns_max": log.write_stall_ns_max if log else 0,
            "cpu_s": round(cpu_s, 3),
            "cpu_ratio": round(cpu_s / max(wall_s, 1e-9), 4),
            "memory_bytes_max": memory_bytes_max(),
            "frames": frame_counts(self.drain.ring, self.settings.axis_names),
            "check": self.check.summary() if self.check else None,
            "log_lacks": ring_layout.log_lacks(self.drain.ring),
            "clock_sets": self._watch.clock_sets,
            "error": None,
        }

    def _closing_metadata(self, reason: int, error: list[str] | None) -> dict[str, dict[str, str]]:
        """The `run` table again, now with how it ended; frame counters; cross-check figures."""
        dropped = self.drain.dropped()
        ended = {
            "exit_reason": status.EXIT_NAMES[reason],
            "exit_reason_code": reason,
            "start_mono_ns": self.start_mono_ns,
            "start_real_ns": self.start_real_ns,
            "clock_offset_ns": self.start_real_ns - self.start_mono_ns,
            "tick_count": self.tick_count,
            "last_tick": self.last_tick,
            "frame_records": self.frame_count,
            "miss_records": self.miss_count,
            "dropped_ticks": dropped.ticks,
            "dropped_misses": dropped.misses,
            "dropped_frames": dropped.frames,
            "lost_bytes": self.log.lost_bytes,
            "lost_messages": self.log.lost_messages,
            "skipped_rows": self.skipped_rows,
            "skipped_periods": self.drain.word(ring_layout.WORD_SKIPPED_TOTAL),
            "kernel_dropped_frames": self.drain.word(ring_layout.WORD_KERNEL_DROPPED),
            "clock_sets": self._watch.clock_sets,
            "log_lacks": "; ".join(ring_layout.log_lacks(self.drain.ring)),
            "stall_ns_max": self.drain.word(ring_layout.WORD_STALL_NS_MAX),
            "stall_count": self.drain.word(ring_layout.WORD_STALL_COUNT),
            "stall_first_tick": self.drain.word(ring_layout.WORD_STALL_TICK_FIRST) - 1,  # -1: none
            "stall_ns_last": self.drain.word(ring_layout.WORD_STALL_NS_LAST),
        }
        if error:
            ended["recorder_error"] = "; ".join(part for part in error if part)
        run = {**self.settings.metadata.get("run", {}), **ended}
        tables = {
            "run": run,
            "frames": frame_counts(self.drain.ring, self.settings.axis_names),
            "clamped": clamped_counts(self.drain.ring, self.settings.sent_signals),
        }
        if self.check:
            tables["check"] = flat(self.check.summary())
        return {name: {key: str(value) for key, value in table.items()} for name, table in tables.items()}


def flat(table: dict, prefix: str = "") -> dict:
    """Nested tables as one, keys joined by a dot; what has no value is left out."""
    out = {}
    for key, value in table.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{key}.")
        elif value is not None:
            out[prefix + key] = value
    return out
