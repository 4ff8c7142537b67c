"""How each limit of a profile (setup.limits) is measured, in one run, from what was gathered of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase

from hilrunner.base.units import M_PER_MM, NS_PER_US, PA_PER_MPA
from hilrunner.evidence.bus import BusUse
from hilrunner.evidence.check_use import CheckUse
from hilrunner.evidence.coverage import Count, Coverage
from hilrunner.evidence.latency import EXACT_SAMPLES_MAX, Distribution, Latency
from hilrunner.evidence.plant_use import AxisUse
from hilrunner.setup.limits import KEYS

EXPLAINING = ("settling_speed_mmps",)  # says how another limit is measured


@dataclass(frozen=True)
class Measured:
    """What a run is judged by."""

    latency: Latency
    bus: BusUse
    axes: list[AxisUse]
    checks: list[CheckUse]
    coverage: Coverage
    axis_names: tuple[str, ...] = ()  # those the run had; empty: not told


@dataclass(frozen=True)
class Value:
    """One figure: NaN where it cannot be told; `detail` says where it stands or why it cannot be told, `over` of how much of the run."""

    value: float
    detail: str
    over: str


def measure(key: str, measured: Measured, missing_fields: dict[str, tuple[str, ...]]) -> Value:
    """The figure a limit is compared with.

    Args:
        key: of setup.limits.KEYS, but not of EXPLAINING.
        missing_fields: topic -> fields its log lacks; a figure that needs one of them cannot be told.
    """
    lacking = _lacking(key, missing_fields)
    if lacking:
        return Value(math.nan, f"the log has no {lacking}", "")
    silent = set(measured.axis_names) - {axis.name for axis in measured.axes}
    if silent and any(pattern.startswith("/*/") and key not in _OF_CHECKS for pattern, _ in _NEEDS.get(key, ())):
        return Value(math.nan, f"the log has no state of axis {', axis '.join(sorted(silent))}", "")
    value, detail = _MEASURES[key](measured)
    return Value(value, detail, _over(key, measured.coverage))


def _lacking(key: str, missing_fields: dict[str, tuple[str, ...]]) -> str:
    for pattern, names in _NEEDS.get(key, ()):
        for topic, absent in missing_fields.items():
            if fnmatchcase(topic, pattern) and set(names) & set(absent):
                return f"{topic} {sorted(set(names) & set(absent))[0]}"
    return ""


def _over(key: str, coverage: Coverage) -> str:
    if key in _OF_FRAMES:
        return coverage.frames.over("frames")
    if key in _OF_CHECKS:
        return "" if coverage.checked is None else coverage.checked.over("ticks")
    return "" if key in _OF_LOG else coverage.ticks.over("ticks")


Measure = Callable[[Measured], tuple[float, str]]


def _largest_us(name: str) -> Measure:
    """By every tick of the log and by the loop's own histogram, which keeps its largest value exactly."""

    def take(measured: Measured) -> tuple[float, str]:
        latency = measured.latency
        found = [one[name] for one in (latency.distributions, latency.loop) if name in one]
        if not found:
            return math.nan, f"the log holds no {name.replace('_', ' ')}"
        return max(one.values_ns["max"] for one in found) / NS_PER_US, _samples(max(found, key=lambda one: one.count))

    return take


def _p999_us(name: str) -> Measure:
    """Exact where every tick is at hand and they are not too many, else by the loop's own histogram, rounded up by at most 1.6 %."""

    def take(measured: Measured) -> tuple[float, str]:
        exact, loop = measured.latency.distributions.get(name), measured.latency.loop.get(name)
        is_whole = exact is not None and (loop is None or loop.count <= exact.count <= EXACT_SAMPLES_MAX)
        found = exact if is_whole else loop
        if found is None:
            return math.nan, f"the log holds no {name.replace('_', ' ')}"
        return found.values_ns["p999"] / NS_PER_US, _samples(found)

    return take


def _samples(found: Distribution) -> str:
    return f"of {found.count} samples" if found.count else found.source


def _over_axes(value: Callable[[AxisUse], float], worst=max, lacking: str = "no axis has a logged state") -> Measure:
    def take(measured: Measured) -> tuple[float, str]:
        values = [(value(axis), axis.name) for axis in measured.axes]
        known = [pair for pair in values if not math.isnan(pair[0])]
        if not known or len(known) < len(values):
            return math.nan, lacking
        return (found := worst(known))[0], f"axis {found[1]}"

    return take


def _flag(name: str) -> Measure:
    return _over_axes(lambda axis: float(axis.flag_ticks.get(name, 0)))


def _check_failures(measured: Measured) -> tuple[float, str]:
    found = sum(check.failed_count for check in measured.checks)
    told = measured.coverage.check_failed_ticks
    if measured.coverage.checked is None:
        return math.nan, "the run had no cross-check"
    if not found and not told:
        return 0.0, ""
    firsts = dict(told) | {
        one.axis: one.first_failed_tick for one in measured.checks if one.first_failed_tick is not None
    }
    places = ", ".join(f"axis {axis} from tick {tick} on" for axis, tick in firsts.items())
    return float(max(found, len(told))), places


def _unchecked(measured: Measured) -> tuple[float, str]:
    checked, error = measured.coverage.checked, measured.coverage.check_error
    if checked is None:
        return math.nan, "the run had no cross-check"
    why = f"the cross-check stopped: {error}" if error else ""
    if checked.had is None:
        return (math.nan, why) if error else (0.0, f"{checked.found} checks in the log")
    return float(checked.lost), why


def _check_error(ending: str, factor: float, quantities: tuple[str, ...]) -> Measure:
    """The largest distance from the reference: what the recorder told of every tick, and what stands in the log."""

    def take(measured: Measured) -> tuple[float, str]:
        logged = [(max(check.error(name).max for name in quantities), check.axis) for check in measured.checks]
        told = [
            (value / factor, key.split(".")[0])
            for key, value in (measured.coverage.check_errors_max or {}).items()
            if key.endswith(ending) and "one_step" not in key and "sustained" not in key
        ]
        if not logged and not told:
            return math.nan, "the run had no cross-check"
        value, axis = max(logged + told)
        return value, f"axis {axis}"

    return take


def _lost(count: Count, noun: str) -> tuple[float, str]:
    if count.lost is None:
        return 0.0, f"the log does not say how many {noun} there were"
    return float(count.lost), f"{count.found} of {count.had} are in the log"


def _ticks_lost(measured: Measured) -> tuple[float, str]:
    count = measured.coverage.ticks
    if count.lost is None:
        gaps = measured.latency.lost_count
        return float(gaps), "by the numbers of the ticks: the log does not say how many ran"
    return float(count.lost), f"{count.found} of {count.had} are in the log"


def _rejected(measured: Measured) -> tuple[float, str]:
    """By the loop's own counters, which know also of frames that are not in the log."""
    told = measured.coverage.rejected or {}
    counts = {name: max(told.get(name, 0), measured.bus.rejected.get(name, 0)) for name in told | measured.bus.rejected}
    worst = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return float(sum(counts.values())), worst


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
    "wake_lateness_us_max": _largest_us("wake_lateness"),
    "wake_lateness_us_p999": _p999_us("wake_lateness"),
    "execution_us_max": _largest_us("execution"),
    "response_us_max": _largest_us("response"),
    "command_age_ms_max": _age_ms,
    "frames_rejected_max": _rejected,
    "bus_load_ratio_max": _bus_load,
    "fail_safe_ms_max": _fail_safe,
    "ticks_lost_max": _ticks_lost,
    "frames_lost_max": lambda m: _lost(m.coverage.frames, "frames"),
    "misses_lost_max": lambda m: _lost(m.coverage.misses, "misses"),
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
    "check_failures_max": _check_failures,
    "unchecked_ticks_max": _unchecked,
    "check_pressure_mpa_max": _check_error(
        "pressure_error_pa_max", PA_PER_MPA, ("chamber 1 pressure", "chamber 2 pressure")
    ),
    "check_position_mm_max": _check_error("rod_position_error_m_max", M_PER_MM, ("rod position",)),
}
_OF_FRAMES = ("frames_rejected_max", "bus_load_ratio_max", "response_us_max")
_OF_CHECKS = ("check_failures_max", "check_pressure_mpa_max", "check_position_mm_max")
_OF_LOG = ("ticks_lost_max", "frames_lost_max", "misses_lost_max", "unchecked_ticks_max")

_LATE = (("/rt/tick", ("tick", "flags")), ("/rt/miss", ("tick", "lateness_ns")))
_WAKE = (("/rt/tick", ("deadline_mono_ns", "wake_mono_ns", "skipped_count")),)
_PRESSURES = (("/*/state", ("chamber_1_pressure_pa", "chamber_2_pressure_pa")),)
_POSITION = (("/*/state", ("rod_position_m",)),)
_TRACKING = (("/*/state", ("tick", "rod_position_m")), ("/*/command", ("tick", "mode")))
_FLAGS = (("/*/state", ("flags",)),)
_CHECKS = (("/*/check", ("tick", "flags")),)
# limit -> (topic, fields) its figure is made of: where one is not in the log, a zero in its place must not pass
_NEEDS: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "deadline_misses_max": _LATE,
    "deadline_miss_ratio_max": (*_LATE, ("/rt/tick", ("skipped_count",))),
    "skipped_periods_max": (("/rt/tick", ("skipped_count",)),),
    "wake_lateness_us_max": _WAKE,
    "wake_lateness_us_p999": _WAKE,
    "execution_us_max": (("/rt/tick", ("wake_mono_ns", "end_mono_ns")),),
    "response_us_max": (("/can/*", ("tick", "kernel_real_ns", "status")),),
    "command_age_ms_max": (("/*/command", ("age_ns", "mode")),),
    "frames_rejected_max": (("/can/*", ("status",)),),
    "bus_load_ratio_max": (("/can/*", ("mono_ns", "can_id", "length", "flags")),),
    "fail_safe_ms_max": (("/*/command", ("age_ns", "mode")),),
    "pressure_mpa_min": _PRESSURES,
    "pressure_mpa_max": _PRESSURES,
    "rod_position_mm_min": _POSITION,
    "rod_position_mm_max": _POSITION,
    "rod_speed_mmps_max": (("/*/state", ("rod_velocity_mps",)),),
    "tracking_error_mm_max": _TRACKING,
    "tracking_error_mm_rms": _TRACKING,
    "settling_ms_max": (("/*/state", ("tick", "rod_velocity_mps")), ("/*/command", ("tick", "valve_command"))),
    "end_stop_ticks_max": _FLAGS,
    "cavitation_ticks_max": _FLAGS,
    "outside_training_ticks_max": _FLAGS,
    "check_failures_max": _CHECKS,
    "check_pressure_mpa_max": (("/*/check", ("chamber_1_pressure_error_pa", "chamber_2_pressure_error_pa")),),
    "check_position_mm_max": (("/*/check", ("rod_position_error_m",)),),
}
assert set(_NEEDS) | set(_OF_LOG) == set(_MEASURES)
assert set(_MEASURES) == set(KEYS) - set(EXPLAINING)
