"""The recorder process: ring in, log out, until the runner ends or dies.

It ignores SIGINT, SIGTERM and SIGHUP: only the end of the runner ends it, so that the log is finished in every case.
"""

import contextlib
import json
import os
import select
import signal
import sys
import time

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.errors import HilrunnerError
from hilrunner.record import config as recorder_config
from hilrunner.record.check_worker import CheckWorker
from hilrunner.record.drain import Drain
from hilrunner.record.launch import READY_OPEN, READY_REFUSED, attach_ring
from hilrunner.record.levels import LOG_LEVEL_ERROR
from hilrunner.record.mcap_log import LogWriter
from hilrunner.record.read_back import check_attachments
from hilrunner.record.recorder import Recorder

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


def run(recorder: Recorder, watch: Watch) -> int:
    """Drain until the runner ends; returns its exit reason (status.EXIT_*)."""
    drain = recorder.drain
    statistics_interval_ns = int(1e9 / recorder.settings.statistics_hz)
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
        recorder.collect_check()
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
    shape = ring_layout.RingShape(*settings.ring_shape)
    attachments = read_attachments(settings)
    log = LogWriter(settings.log_path, settings.axis_names, shape.can_data_size, settings.metadata, attachments)
    check_attachments(log.path, attachments)
    return log


def read_attachments(settings: recorder_config.RecorderConfig) -> list[tuple[str, str, bytes]]:
    """(name, media type, data) of every file the log is to keep."""
    attachments = []
    for one in settings.attachments:
        attachments.append((one.name, one.media_type, attachment_data(one)))
    return attachments


def attachment_data(one: recorder_config.Attachment) -> bytes:
    """The bytes of a file that goes into the log."""
    if one.fd is not None:
        return os.pread(one.fd, os.fstat(one.fd).st_size, 0)
    if one.path is not None:
        with open(one.path, "rb") as file:
            return file.read()
    return (one.text or "").encode()


def open_live(settings: recorder_config.RecorderConfig):
    """The WebSocket server of the live view, or None when none is wanted."""
    if settings.live_port is None:
        return None
    from hilrunner.record.live import LiveView

    return LiveView(settings)


def main(make_log=open_log) -> int:
    """Entry of `python -m hilrunner.record`; exit code 0 when the log was finished, 2 when it was refused.

    Args:
        make_log: called with the settings; gives the log, None, or what takes records in place of a log (evidence.tally).
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    text = sys.stdin.read()
    if not text:
        return 0  # the runner died before it said anything: there is nothing to record
    settings = recorder_config.decode(text)
    leave_realtime(settings.cpus)
    shape = ring_layout.RingShape(*settings.ring_shape)
    _, ring = attach_ring(settings.ring_fd, shape)
    drain = Drain(ring, shape)
    watch = Watch(settings.parent_pid)
    try:
        live = open_live(settings)  # first: a port in use shall leave no log behind
        recorder = Recorder(settings, drain, make_log(settings), live=live)
    except (HilrunnerError, OSError) as error:
        report({"error": error_parts(error)})
        drain.store(ring_layout.WORD_RECORDER_READY, READY_REFUSED)
        return 2
    drain.store(ring_layout.WORD_RECORDER_READY, READY_OPEN)
    if settings.check is not None:  # started behind the open log: compiling it may take its time
        recorder.check = CheckWorker(settings.check, settings.axis_names, settings.period_ns)
    return record(recorder, watch)


def record(recorder: Recorder, watch: Watch) -> int:
    """Drain to the end and finish the log, whatever goes wrong on the way."""
    reason = None
    error = None
    try:
        reason = run(recorder, watch)
    except Exception as caught:
        error = error_parts(caught)
        recorder.event(LOG_LEVEL_ERROR, f"recorder failed: {error[1]}")
    if reason is None:  # the run may go on; the log says that it was running when it ended
        reason = recorder.drain.word(ring_layout.WORD_EXIT_REASON)
    try:
        recorder.finish(reason, error)
    except Exception as caught:
        error = error or error_parts(caught)
    report({**recorder.summary(reason), "error": error})
    return 0 if error is None else 1


def error_parts(error: Exception) -> list[str]:
    """Place, problem, limit and remedy of an error, for the runner to raise again."""
    if isinstance(error, HilrunnerError):
        return [error.place, error.problem, error.limit, error.remedy]
    return ["recorder", f"{type(error).__name__}: {error}", "", ""]


def report(summary: dict) -> None:
    """One JSON line for the runner; nobody reads it when the runner is dead."""
    with contextlib.suppress(OSError):
        sys.stdout.write(json.dumps(summary) + "\n")
        sys.stdout.flush()
