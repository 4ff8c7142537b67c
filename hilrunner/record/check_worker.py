"""The online cross-check beside the drain: a thread of its own, a bounded backlog, results for the log.

The compiled check holds no GIL, and compiling it (first run after a change) happens on this thread as well: the drain is
never kept waiting. What does not fit into the backlog is left out and counted; the check restarts behind the gap.
"""

import contextlib
import math
import os
import pickle
import threading
import time
from collections import deque
from typing import NamedTuple

import numpy as np

from hilrunner.base import records
from hilrunner.base.units import NS_PER_S
from hilrunner.record.config import CheckConfig

BACKLOG_TICKS_MAX = 300_000  # per axis; about 70 MB, five minutes at 1 kHz
BATCH_TICKS_MAX = 512  # bounds how old a result gets
NICENESS = 10  # the log comes first


class CheckBatch(NamedTuple):
    """Records of one axis with the times its results carry."""

    axis: int
    skipped: np.ndarray  # (n,) int64
    command: np.ndarray  # (n,) COMMAND
    state: np.ndarray  # (n,) STATE
    log_real_ns: np.ndarray  # (n,) int64
    publish_real_ns: np.ndarray  # (n,) int64


class CheckResult(NamedTuple):
    """CHECK records of one axis, ready for the log."""

    axis: int
    check: np.ndarray
    log_real_ns: np.ndarray
    publish_real_ns: np.ndarray


class Failure(NamedTuple):
    """The first tick of an axis out of tolerance."""

    tick: int
    text: str


class CheckWorker:
    """Runs the cross-check of all axes."""

    def __init__(self, settings: CheckConfig, axis_names: list[str], period_ns: int) -> None:
        self._settings = settings
        self._axis_names = axis_names
        self._period_ns = period_ns
        self._todo: deque[CheckBatch] = deque()
        self._done: deque[CheckResult] = deque()
        self._failures: deque[Failure] = deque()
        self._wake = threading.Condition()
        self._ending = False
        self._backlog_ticks = 0
        self._newest_tick = -1
        self._checked_tick = -1
        self.left_out_ticks = 0
        self.lag_ns = 0
        self.lag_ns_max = 0
        self.cpu_s = 0.0
        self.arm_s = 0.0
        self.error = ""
        self._walks: list = []
        self._told = [False] * len(axis_names)
        self._thread = threading.Thread(target=self._run, name="crosscheck", daemon=True)
        self._thread.start()

    @property
    def backlog_ticks(self) -> int:
        """Ticks of one axis that wait for the check."""
        return self._backlog_ticks // max(1, len(self._axis_names))

    def take_ticks(self, tick, command, state, log_real_ns, publish_real_ns) -> None:
        """Queue whole periods (views are copied): tick (n,), command and state (n * axis_count,)."""
        axes = len(self._axis_names)
        count = len(tick)
        if self.error or self._backlog_ticks + count * axes > BACKLOG_TICKS_MAX * axes:
            self.left_out_ticks += count
            return
        skipped = tick["skipped_count"].astype(np.int64)
        with self._wake:
            self._newest_tick = int(tick["tick"][-1])
            for start in range(0, count, BATCH_TICKS_MAX):
                part = slice(start, start + BATCH_TICKS_MAX)
                for axis in range(axes):
                    batch = CheckBatch(
                        axis,
                        skipped[part],
                        np.ascontiguousarray(command[axis::axes][part]),
                        np.ascontiguousarray(state[axis::axes][part]),
                        log_real_ns[part],
                        publish_real_ns[part],
                    )
                    # contiguous slices stay views of the ring: copy
                    batch = batch._replace(command=batch.command.copy(), state=batch.state.copy())
                    self._todo.append(batch)
                    self._backlog_ticks += len(batch.state)
            self._wake.notify()

    def results(self) -> list[CheckResult]:
        """Records finished since the last call."""
        return [self._done.popleft() for _ in range(len(self._done))]

    def failures(self) -> list[Failure]:
        """Axes that left their tolerance since the last call."""
        return [self._failures.popleft() for _ in range(len(self._failures))]

    def finish(self, timeout_s: float) -> bool:
        """Work off the backlog; False when time ran out (the rest counts as left out)."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            with self._wake:
                self.left_out_ticks += self._backlog_ticks // max(len(self._axis_names), 1)
                self._todo.clear()
            return False
        return True

    def summary(self) -> dict:
        """Figures of the check: an entry an axis, and how the check itself fared."""
        axes = {name: _axis_summary(walk) for name, walk in zip(self._axis_names, self._walks, strict=False)}
        return {
            **axes,
            "left_out_ticks": self.left_out_ticks,
            "lag_ns_max": self.lag_ns_max,
            "cpu_s": round(self.cpu_s, 3),
            "arm_s": round(self.arm_s, 3),
            "error": self.error,
        }

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        try:
            begin_s = time.monotonic()
            step = self._arm()
            self.arm_s = time.monotonic() - begin_s
            while (batch := self._next()) is not None:
                begin_s = time.thread_time()
                step(batch)
                self.cpu_s += time.thread_time() - begin_s
        except Exception as error:  # whatever the check runs into, the log goes on
            self.error = f"{type(error).__name__}: {error}"

    def _next(self) -> CheckBatch | None:
        with self._wake:
            while not self._todo:
                if self._ending:
                    return None
                self._wake.wait()
            return self._todo.popleft()

    def _arm(self):
        """Load, assemble and compile; returns what works off one batch."""
        from hilrunner.record import crosscheck  # numba and the plant: only here, off the path to the open log

        settings = self._settings
        with open(settings.plants_fd, "rb") as file:
            file.seek(0)
            plants, stimulus = pickle.load(file)
        if stimulus is None:
            stimulus = np.zeros((len(plants), 0))
        period_s = self._period_ns / NS_PER_S
        model = crosscheck.reference_model(plants, period_s)
        limits = limit_row(settings)
        self._walks = [crosscheck.new_walk(np.array(state)) for state in settings.initial_states]

        def step(batch: CheckBatch) -> None:
            check = records.allocate(records.CHECK, len(batch.state))
            walk = self._walks[batch.axis]
            crosscheck.check_periods(
                model, batch.axis, period_s, batch.skipped, batch.command, batch.state, walk, limits,
                settings.one_step_decimation, stimulus[batch.axis], check,
            )  # fmt: skip
            self._deliver(batch, check, walk)

        empty = CheckBatch(
            0,
            np.zeros(0, np.int64),
            records.allocate(records.COMMAND, 0),
            records.allocate(records.STATE, 0),
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
        )
        step(empty)  # compile before the first tick arrives
        return step

    def _deliver(self, batch: CheckBatch, check: np.ndarray, walk) -> None:
        from hilrunner.record.crosscheck import WALK_FAILED_TICK

        if not len(check):
            return
        with self._wake:
            self._backlog_ticks -= len(check)
            newest = self._newest_tick
        self.lag_ns = (newest - int(check["tick"][-1])) * self._period_ns
        check["lag_ns"] = (newest - check["tick"].astype(np.int64)) * self._period_ns
        self.lag_ns_max = max(self.lag_ns_max, int(check["lag_ns"].max()))
        failed_tick = int(walk.number[WALK_FAILED_TICK])
        if failed_tick >= 0 and not self._told[batch.axis]:
            self._told[batch.axis] = True
            self._failures.append(Failure(failed_tick, self._failure_text(batch.axis, failed_tick, walk)))
        every = self._settings.record_decimation
        kept = (check["tick"] % every == 0) | (check["tick"] == max(failed_tick, 0))
        self._done.append(CheckResult(batch.axis, check[kept], batch.log_real_ns[kept], batch.publish_real_ns[kept]))

    def _failure_text(self, axis: int, tick: int, walk) -> str:
        from hilrunner.record.crosscheck import ERROR_KINDS, QUANTITIES, QUANTITY_COUNT, WALK_FAILED_ROW

        row = int(walk.number[WALK_FAILED_ROW])
        name, unit = QUANTITIES[row % QUANTITY_COUNT].rsplit("_", 1)
        return (
            f"cross-check {self._axis_names[axis]}: {name.replace('_', ' ')} {ERROR_KINDS[row // QUANTITY_COUNT]} is "
            f"{float(walk.failed_error[0]):+.4g} {unit} off the first-principle model at tick {tick}; "
            f"allowed: {float(walk.failed_error[1]):.4g} {unit}"
        )


def limit_row(settings: CheckConfig) -> np.ndarray:
    """Largest errors allowed, rows as in crosscheck.Walk.accumulated; what has no tolerance is infinite."""
    free = (
        settings.position_tolerance_m,
        settings.velocity_tolerance_mps,
        settings.pressure_tolerance_pa,
        settings.pressure_tolerance_pa,
    )
    one_step = (
        settings.one_step_position_tolerance_m,
        None,
        settings.one_step_pressure_tolerance_pa,
        settings.one_step_pressure_tolerance_pa,
    )
    sustained = (None, None, settings.sustained_pressure_tolerance_pa, settings.sustained_pressure_tolerance_pa)
    return np.array([math.inf if limit is None else limit for limit in free + one_step + sustained])


def _axis_summary(walk) -> dict:
    from hilrunner.record import crosscheck

    figures: dict[str, float | int | None] = {}
    for row in range(crosscheck.ROW_COUNT):
        name, unit = crosscheck.QUANTITIES[row % crosscheck.QUANTITY_COUNT].rsplit("_", 1)
        prefix = ("", "one_step_", "sustained_")[row // crosscheck.QUANTITY_COUNT]
        largest, at, squares, count = walk.accumulated[row]
        figures[f"{prefix}{name}_error_{unit}_max"] = _finite(largest)
        figures[f"{prefix}{name}_error_{unit}_rms"] = _finite(math.sqrt(squares / count)) if count else 0.0
        figures[f"{prefix}{name}_error_max_tick"] = int(at)
    for name_and_unit, spread in zip(crosscheck.QUANTITIES, walk.spread_max, strict=True):
        name, unit = name_and_unit.rsplit("_", 1)
        figures[f"neighbour_{name}_distance_{unit}_max"] = float(spread)
    failed = int(walk.number[crosscheck.WALK_FAILED_TICK])
    figures["checked_ticks"] = int(walk.accumulated[0, crosscheck.SUM_COUNT])
    figures["one_step_ticks"] = int(walk.accumulated[crosscheck.QUANTITY_COUNT, crosscheck.SUM_COUNT])
    figures["restart_count"] = int(walk.number[crosscheck.WALK_RESTART_COUNT])
    figures["failed_tick"] = failed if failed >= 0 else None
    return figures


def _finite(value: float) -> float | None:
    """The value, or None (JSON has no infinity) where an error was no number."""
    return float(value) if math.isfinite(value) else None
