"""The `[limits]` table of a profile: what a run must keep to pass its verdict. Every key is optional; no key, no limit.

The names live here, in set-up, so that `hilrunner check` refuses a misspelt limit before the run and the evidence room
judges by the same words after it.
"""

import math
from dataclasses import dataclass

from hilrunner.base.errors import ProfileError


@dataclass(frozen=True)
class LimitSpec:
    """One limit: `key` with its unit last, accepted range of the value, and what it is compared with."""

    key: str
    lowest: float
    highest: float
    doc: str


_COUNT = 1e12

SPEC = (
    # time
    LimitSpec("deadline_misses_max", 0, _COUNT, "ticks that ended after their period"),
    LimitSpec("deadline_miss_ratio_max", 0, 1, "late ticks and skipped periods over all periods"),
    LimitSpec("skipped_periods_max", 0, _COUNT, "periods lost to late ticks"),
    LimitSpec("wake_lateness_us_max", 0, 1e9, "largest wake-up lateness; a skipped period is a late sample"),
    LimitSpec("wake_lateness_us_p999", 0, 1e9, "99.9th percentile of the wake-up lateness"),
    LimitSpec("execution_us_max", 0, 1e9, "longest tick from wake-up to end"),
    LimitSpec("response_us_max", 0, 1e9, "kernel's receive stamp of a command to the first measurement sent after it"),
    LimitSpec("command_age_ms_max", 0, 1e9, "age of the newest valid command while the firmware is active"),
    # bus
    LimitSpec("frames_rejected_max", 0, _COUNT, "received command frames that were refused"),
    LimitSpec("bus_load_ratio_max", 0, 1, "worst second of the bus (needs the bit rate)"),
    LimitSpec("fail_safe_ms_max", 0, 1e9, "last valid command to the latched fail-safe, each time it happened"),
    # log
    LimitSpec("ticks_lost_max", 0, _COUNT, "ticks that ran but are not in the log (default 0)"),
    LimitSpec("frames_lost_max", 0, _COUNT, "frames received or sent that are not in the log (default 0)"),
    LimitSpec("misses_lost_max", 0, _COUNT, "misses whose cause is not in the log (default 0)"),
    # plant
    LimitSpec("pressure_mpa_min", -1, 1000, "lowest chamber pressure, gauge"),
    LimitSpec("pressure_mpa_max", -1, 1000, "highest chamber pressure, gauge"),
    LimitSpec("rod_position_mm_min", -1e5, 1e5, "lowest rod position"),
    LimitSpec("rod_position_mm_max", -1e5, 1e5, "highest rod position"),
    LimitSpec("rod_speed_mmps_max", 0, 1e5, "largest rod speed, either way"),
    LimitSpec("tracking_error_mm_max", 0, 1e5, "largest distance from the reference motion while active"),
    LimitSpec("tracking_error_mm_rms", 0, 1e5, "RMS distance from the reference motion while active"),
    LimitSpec("settling_ms_max", 0, 1e9, "valve back at neutral until the rod stays below settling_speed_mmps"),
    LimitSpec("settling_speed_mmps", 0, 1e5, "what counts as standing still (default 0.5)"),
    LimitSpec("end_stop_ticks_max", 0, _COUNT, "ticks at an end stop"),
    LimitSpec("cavitation_ticks_max", 0, _COUNT, "ticks with a cavitating chamber"),
    LimitSpec("outside_training_ticks_max", 0, _COUNT, "ticks outside the surrogate's training range"),
    # model
    LimitSpec("check_failures_max", 0, _COUNT, "ticks out of the cross-check's tolerance (default 0)"),
    LimitSpec("unchecked_ticks_max", 0, _COUNT, "ticks the cross-check has not looked at (default 0)"),
    LimitSpec("check_pressure_mpa_max", 0, 1000, "largest pressure distance from the first-principle reference"),
    LimitSpec("check_position_mm_max", 0, 1e5, "largest position distance from the first-principle reference"),
)
KEYS = {spec.key: spec for spec in SPEC}
SETTLING_SPEED_MMPS = 0.5
# judged in every run, also where the profile names no limit: what is missing or wrong by itself never passes
DEFAULTS = {
    "ticks_lost_max": 0.0,
    "frames_lost_max": 0.0,
    "misses_lost_max": 0.0,
    "check_failures_max": 0.0,
    "unchecked_ticks_max": 0.0,
}
_UNITS = {
    "us": "us", "ms": "ms", "mm": "mm", "mmps": "mm/s", "mpa": "MPa", "ratio": "", "ticks": "ticks", "misses": "misses",
    "periods": "periods", "frames": "frames", "failures": "ticks",
}  # fmt: skip


def unit_of(key: str) -> str:
    """The unit of a limit, read from its key; empty for a ratio."""
    return next((_UNITS[word] for word in reversed(key.split("_")) if word in _UNITS), "")


def read_limits(table: dict, place: str = "limits") -> dict[str, float]:
    """The checked limits of a profile.

    Args:
        table: the `[limits]` table as parsed from TOML.
        place: where it stands, for the error (`profiles/x.toml: limits`).

    Raises ProfileError for an unknown key, a value that is no finite number, or one out of range.
    """
    limits = {}
    for key, value in table.items():
        spec = KEYS.get(key)
        if spec is None:
            raise ProfileError(f"{place}.{key}", "no such limit", ", ".join(KEYS), "correct or remove the key")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ProfileError(f"{place}.{key}", f"{value!r} is not a finite number", "a number", "give a number")
        if not spec.lowest <= value <= spec.highest:
            raise ProfileError(
                f"{place}.{key}", f"{value:g} is out of range", f"{spec.lowest:g} to {spec.highest:g}", spec.doc
            )
        limits[key] = float(value)
    for low, high in (("pressure_mpa_min", "pressure_mpa_max"), ("rod_position_mm_min", "rod_position_mm_max")):
        if low in limits and high in limits and limits[low] >= limits[high]:
            raise ProfileError(f"{place}.{low}", f"{limits[low]:g} is not below {high} = {limits[high]:g}")
    return limits
