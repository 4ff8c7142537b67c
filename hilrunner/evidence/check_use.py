"""The online cross-check of a run, summed up: how far the surrogate was from the first-principle reference.

Summed batch by batch while the log is read.
"""

from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.units import M_PER_MM, NS_PER_MS, PA_PER_MPA

# quantity -> (field of base.records.CHECK, factor to the unit shown, unit shown)
QUANTITIES = {
    "chamber 1 pressure": ("chamber_1_pressure_error_pa", PA_PER_MPA, "MPa"),
    "chamber 2 pressure": ("chamber_2_pressure_error_pa", PA_PER_MPA, "MPa"),
    "rod position": ("rod_position_error_m", M_PER_MM, "mm"),
    "rod velocity": ("rod_velocity_error_mps", M_PER_MM, "mm/s"),
}
_OUT_OF_TOLERANCE = 1
_STRETCH_ROWS = 50
_PLOT_POINTS = 600


@dataclass(frozen=True)
class ErrorSummary:
    """Distance of one quantity from the reference, in `unit`."""

    quantity: str
    unit: str
    max: float
    rms: float
    one_step_max: float
    one_step_rms: float
    worst_tick: int


@dataclass(frozen=True)
class CheckUse:
    """One axis' cross-check."""

    axis: str
    tick_count: int
    failed_count: int
    first_failed_tick: int | None
    lag_ms_max: float
    errors: list[ErrorSummary]
    traces: dict[str, np.ndarray]  # largest distances in stretches, for a plot

    def error(self, quantity: str) -> ErrorSummary:
        """Summary of one quantity of QUANTITIES."""
        return next(error for error in self.errors if error.quantity == quantity)


@dataclass
class _Sums:
    """Of one quantity: largest absolute value with its tick, sum of squares and count; the same of the one-step error."""

    largest: float = 0.0
    tick: int = 0
    squares: float = 0.0
    count: int = 0
    step_largest: float = 0.0
    step_squares: float = 0.0
    step_count: int = 0
    stretches: list[np.ndarray] = field(default_factory=list)


class CheckTally:
    """Consumer of `/<axis>/check` topics (evidence.reader)."""

    COLUMNS = (
        "tick",
        "lag_ns",
        "flags",
        *(name for name, _, _ in QUANTITIES.values()),
        *(f"one_step_{name}" for name, _, _ in QUANTITIES.values()),
    )

    def __init__(self, keep_traces: bool = True) -> None:
        self._axes: dict[str, _AxisTally] = {}
        self._keep_traces = keep_traces

    def __call__(self, topic: str, rows: np.ndarray) -> None:
        """Sum one batch."""
        if len(rows):
            self._axes.setdefault(topic.split("/")[1], _AxisTally(self._keep_traces)).take(rows)

    def results(self, period_ns: int) -> list[CheckUse]:
        """Cross-checks of every axis that had any."""
        return [tally.result(axis, period_ns) for axis, tally in self._axes.items()]


class _AxisTally:
    def __init__(self, keep_traces: bool) -> None:
        self._keep_traces = keep_traces
        self.count = 0
        self.failed_count = 0
        self.first_failed: int | None = None
        self.lag_ns = 0
        self.ticks: list[np.ndarray] = []
        self.sums = {name: _Sums() for name in QUANTITIES}

    def take(self, rows: np.ndarray) -> None:
        """One batch of CHECK rows."""
        failed = np.flatnonzero(rows["flags"] & _OUT_OF_TOLERANCE)
        if len(failed) and self.first_failed is None:
            self.first_failed = int(rows["tick"][failed[0]])
        self.count += len(rows)
        self.failed_count += len(failed)
        self.lag_ns = max(self.lag_ns, int(rows["lag_ns"].max()))
        starts = np.arange(0, len(rows), _STRETCH_ROWS)[: None if self._keep_traces else 0]
        self.ticks.append(rows["tick"][starts])
        for name, (column, _, _) in QUANTITIES.items():
            _add(self.sums[name], rows["tick"], np.abs(rows[column]), np.abs(rows[f"one_step_{column}"]), starts)

    def result(self, axis: str, period_ns: int) -> CheckUse:
        """What was summed."""
        tick = np.concatenate(self.ticks)
        if not len(tick):
            return self._use(axis, {})
        starts = np.unique(np.linspace(0, len(tick), min(_PLOT_POINTS, len(tick)), endpoint=False).astype(np.int64))
        traces = {"time_s": tick[starts] * (period_ns * 1e-9)}
        for name, (_, factor, _) in QUANTITIES.items():
            traces[name] = np.maximum.reduceat(np.concatenate(self.sums[name].stretches), starts) / factor
        return self._use(axis, traces)

    def _use(self, axis: str, traces: dict[str, np.ndarray]) -> CheckUse:
        return CheckUse(
            axis=axis,
            tick_count=self.count,
            failed_count=self.failed_count,
            first_failed_tick=self.first_failed,
            lag_ms_max=self.lag_ns / NS_PER_MS,
            errors=[_summary(name, self.sums[name]) for name in QUANTITIES],
            traces=traces,
        )


def _add(sums: _Sums, tick: np.ndarray, error: np.ndarray, one_step: np.ndarray, starts: np.ndarray) -> None:
    error = np.where(np.isfinite(error), error, np.inf)  # a distance that is no number is the worst there is
    worst = int(np.argmax(error))
    if error[worst] > sums.largest or not sums.count:
        sums.largest, sums.tick = float(error[worst]), int(tick[worst])
    sums.squares += float(np.square(error).sum())
    sums.count += len(error)
    if len(starts):
        sums.stretches.append(np.maximum.reduceat(error, starts))
    one_step = one_step[np.isfinite(one_step)]  # a decimated one-step check leaves NaN between
    sums.step_largest = max(sums.step_largest, float(one_step.max(initial=0.0)))
    sums.step_squares += float(np.square(one_step).sum())
    sums.step_count += len(one_step)


def _summary(quantity: str, sums: _Sums) -> ErrorSummary:
    _, factor, unit = QUANTITIES[quantity]
    return ErrorSummary(
        quantity=quantity,
        unit=unit,
        max=sums.largest / factor,
        rms=(sums.squares / max(sums.count, 1)) ** 0.5 / factor,
        one_step_max=sums.step_largest / factor,
        one_step_rms=(sums.step_squares / max(sums.step_count, 1)) ** 0.5 / factor,
        worst_tick=sums.tick,
    )
