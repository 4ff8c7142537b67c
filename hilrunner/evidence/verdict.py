"""The verdict of a run: each limit of its profile against what was measured.

A limit that cannot be judged (the log lacks what it needs) fails: a pass must be shown, never assumed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from hilrunner.base import exit_codes, status
from hilrunner.base.units import NS_PER_US
from hilrunner.evidence.bus import BusUse
from hilrunner.evidence.check_use import CheckUse
from hilrunner.evidence.latency import Latency
from hilrunner.evidence.plant_use import AxisUse
from hilrunner.setup.limits import KEYS

PASSED, FAILED, NOT_JUDGED = "passed", "failed", "not judged"
_EXPLAINING = ("settling_speed_mmps",)  # says how another limit is measured
_PLANNED = tuple(
    status.EXIT_NAMES[code] for code in (status.EXIT_DURATION, status.EXIT_SIGNAL, status.EXIT_STIMULUS_END)
)
_MODEL_KEYS = ("check_failures_max", "check_pressure_mpa_max", "check_position_mm_max")


@dataclass(frozen=True)
class Measured:
    """What a run is judged by."""

    latency: Latency
    bus: BusUse
    axes: list[AxisUse]
    checks: list[CheckUse]


@dataclass(frozen=True)
class Judgement:
    """One limit: `value` NaN where it cannot be told; `detail` says where the value stands or why it cannot be told."""

    key: str
    doc: str
    limit: float
    value: float
    outcome: str
    detail: str


@dataclass(frozen=True)
class Verdict:
    """How the run ended, and all limits of its profile."""

    judgements: list[Judgement]

    @property
    def passed(self) -> bool:
        """No limit failed and none was left unjudged."""
        return all(judgement.outcome == PASSED for judgement in self.judgements)

    @property
    def exit_code(self) -> int:
        """0; 5 when only or also the model's limits failed; 1 for any other failure."""
        failed = [judgement.key for judgement in self.judgements if judgement.outcome != PASSED]
        if not failed:
            return exit_codes.PASSED
        if any(key in _MODEL_KEYS for key in failed):
            return exit_codes.CROSS_CHECK_FAILED
        return exit_codes.VERDICT_FAILED


def judge(limits: dict[str, float], measured: Measured, exit_reason: str) -> Verdict:
    """Compare every limit (setup.limits) with the run, and how it ended with how a run should end.

    Args:
        exit_reason: of status.EXIT_NAMES; any other text: not known.
    """
    judged = [_judge_one(key, limits[key], measured) for key in limits if key not in _EXPLAINING]
    return Verdict([_judge_end(exit_reason), *judged])


def _judge_end(exit_reason: str) -> Judgement:
    planned = exit_reason in _PLANNED
    outcome = PASSED if planned else FAILED if exit_reason in status.EXIT_NAMES else NOT_JUDGED
    value = 1.0 if planned else 0.0 if outcome == FAILED else math.nan
    return Judgement("ended_as_planned", "the run ended as planned", 1.0, value, outcome, exit_reason)


def _judge_one(key: str, limit: float, measured: Measured) -> Judgement:
    if key not in _MEASURES:
        return Judgement(key, "not a limit of this version", limit, math.nan, NOT_JUDGED, "written by another version")
    value, detail = _MEASURES[key](measured)
    if math.isnan(value):
        outcome = NOT_JUDGED
    else:
        is_floor = key.endswith("_min")
        outcome = PASSED if (value >= limit if is_floor else value <= limit) else FAILED
    return Judgement(key, KEYS[key].doc, limit, value, outcome, detail)


Measure = Callable[[Measured], tuple[float, str]]


def _percentile_us(name: str, statistic: str) -> Measure:
    def measure(measured: Measured) -> tuple[float, str]:
        found = measured.latency.distributions.get(name)
        if found is None:
            return math.nan, f"the log holds no {name.replace('_', ' ')}"
        return found.values_ns[statistic] / NS_PER_US, f"of {found.count} samples" if found.count else found.source

    return measure


def _over_axes(value: Callable[[AxisUse], float], worst=max, lacking: str = "no axis has a logged state") -> Measure:
    def measure(measured: Measured) -> tuple[float, str]:
        values = [(value(axis), axis.name) for axis in measured.axes]
        known = [pair for pair in values if not math.isnan(pair[0])]
        if not known or len(known) < len(values):
            return math.nan, lacking
        return (found := worst(known))[0], f"axis {found[1]}"

    return measure


def _flag(name: str) -> Measure:
    return _over_axes(lambda axis: float(axis.flag_ticks.get(name, 0)))


def _over_checks(value: Callable[[CheckUse], float]) -> Measure:
    def measure(measured: Measured) -> tuple[float, str]:
        if not measured.checks:
            return math.nan, "the log holds no cross-check"
        worst = max(measured.checks, key=value)
        return value(worst), f"axis {worst.axis}, {worst.tick_count} ticks checked"

    return measure


def _miss_ratio(measured: Measured) -> tuple[float, str]:
    late = measured.latency.miss_count + measured.latency.skipped_count
    periods = measured.latency.tick_count - measured.latency.warm_up_ticks + measured.latency.skipped_count
    return (late / periods, f"{late} of {periods} periods") if periods else (math.nan, "no ticks")


def _fail_safe(measured: Measured) -> tuple[float, str]:
    times = [time for axis in measured.axes for time in axis.fail_safe_ms]
    if not measured.axes:
        return math.nan, "no axis has a logged state"
    return (max(times), f"{len(times)} times") if times else (0.0, "did not happen")


def _settling(measured: Measured) -> tuple[float, str]:
    stops = sum(axis.stop_count for axis in measured.axes)
    unsettled = sum(axis.unsettled_count for axis in measured.axes)
    if not measured.axes:
        return math.nan, "no axis has a logged state"
    if not stops:
        return math.nan, "the valve never stopped"
    if unsettled:
        return math.inf, f"{unsettled} of {stops} stops ended before the rod stood still"
    return max(axis.settling_ms_max for axis in measured.axes if axis.stop_count), f"{stops} stops"


def _bus_load(measured: Measured) -> tuple[float, str]:
    if not measured.bus.bitrate or not len(measured.bus.load_per_s):
        return math.nan, "no bit rate or no frames in the log"
    return measured.bus.load_ratio_max, f"at {measured.bus.bitrate / 1000:g} kbit/s, worst-case stuffing"


def _age_ms(measured: Measured) -> tuple[float, str]:
    if not measured.axes:
        return math.nan, "no axis has a logged state"
    worst = max(measured.axes, key=lambda axis: axis.command_age_ms_max_active)
    return worst.command_age_ms_max_active, f"axis {worst.name}"


_NO_REFERENCE = "no reference motion: the profile has no wave and --reference was not given"

_MEASURES: dict[str, Measure] = {
    "deadline_misses_max": lambda m: (float(m.latency.miss_count), f"of {m.latency.tick_count} ticks"),
    "deadline_miss_ratio_max": _miss_ratio,
    "skipped_periods_max": lambda m: (float(m.latency.skipped_count), ""),
    "wake_lateness_us_max": _percentile_us("wake_lateness", "max"),
    "wake_lateness_us_p999": _percentile_us("wake_lateness", "p999"),
    "execution_us_max": _percentile_us("execution", "max"),
    "response_us_max": _percentile_us("response", "max"),
    "command_age_ms_max": _age_ms,
    "frames_rejected_max": lambda m: (float(sum(m.bus.rejected.values())), f"of {m.bus.received_count} received"),
    "bus_load_ratio_max": _bus_load,
    "fail_safe_ms_max": _fail_safe,
    "ticks_lost_max": lambda m: (float(m.latency.lost_count), ""),
    "pressure_mpa_min": _over_axes(lambda axis: axis.pressure_mpa_min, min),
    "pressure_mpa_max": _over_axes(lambda axis: axis.pressure_mpa_max),
    "rod_position_mm_min": _over_axes(lambda axis: axis.position_mm_min, min),
    "rod_position_mm_max": _over_axes(lambda axis: axis.position_mm_max),
    "rod_speed_mmps_max": _over_axes(lambda axis: axis.speed_mmps_max),
    "tracking_error_mm_max": _over_axes(lambda axis: axis.tracking_mm_max, lacking=_NO_REFERENCE),
    "tracking_error_mm_rms": _over_axes(lambda axis: axis.tracking_mm_rms, lacking=_NO_REFERENCE),
    "settling_ms_max": _settling,
    "end_stop_ticks_max": _flag("end stop"),
    "cavitation_ticks_max": _flag("cavitation"),
    "outside_training_ticks_max": _flag("outside training range"),
    "check_failures_max": _over_checks(lambda check: float(check.failed_count)),
    "check_pressure_mpa_max": _over_checks(
        lambda check: max(check.error("chamber 1 pressure").max, check.error("chamber 2 pressure").max)
    ),
    "check_position_mm_max": _over_checks(lambda check: check.error("rod position").max),
}
assert set(_MEASURES) == set(KEYS) - set(_EXPLAINING)
