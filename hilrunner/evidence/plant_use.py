"""What the actuator did in a run: ranges, flags, stops, fail-safes, distance from the reference motion."""

from dataclasses import dataclass, field

import numpy as np

from hilrunner.base import status
from hilrunner.base.units import M_PER_MM, NS_PER_MS, PA_PER_MPA
from hilrunner.evidence.facts import RunFacts
from hilrunner.evidence.reader import Run
from hilrunner.plant.load import Crane, tip_ratio
from hilrunner.plant.wave import heave_components, heave_series
from hilrunner.setup.profile import Axis

NEUTRAL_COMMAND = 0.005  # half a percent of the spool's travel
MOVED_COMMAND = 0.05  # a stop is a stop from at least this
STOP_S_MIN = 0.2  # shorter stretches at neutral are changes of direction, not stops


@dataclass(frozen=True)
class AxisUse:
    """One axis. Pressures MPa (gauge), positions mm, speeds mm/s, times ms."""

    name: str
    pressure_mpa_min: float
    pressure_mpa_max: float
    position_mm_min: float
    position_mm_max: float
    speed_mmps_max: float
    command_min: float
    command_max: float
    flag_ticks: dict[str, int]
    mode_ticks: dict[str, int]
    command_age_ms_max_active: float
    fail_safe_ms: list[float]  # age of the newest valid command at each entry
    stop_count: int
    settling_ms_max: float  # over all stops; NaN: none
    unsettled_count: int  # stops that were left before the rod stood still
    tracking_mm_max: float  # NaN: no reference motion
    tracking_mm_rms: float
    traces: dict[str, np.ndarray] = field(default_factory=dict)  # thinned, for plots


def measure_plant(
    run: Run, facts: RunFacts, settling_speed_mmps: float, reference: dict[str, np.ndarray] | None = None
) -> list[AxisUse]:
    """Use of every axis with at least one logged state.

    Args:
        settling_speed_mmps: speed below which the rod stands still.
        reference: axis -> float64[n, 2] (time since tick 0 in s, rod position in m) to track instead of the profile's wave.
    """
    profiles = {axis.name: axis for axis in facts.profile.axis} if facts.profile else {}
    uses = []
    for name, state in run.state.items():
        if not len(state):
            continue
        command = run.command.get(name)
        given = (reference or {}).get(name)
        target = _reference_m(state, facts.period_ns, profiles.get(name), given)
        uses.append(_axis_use(name, state, command, target, facts.period_ns, settling_speed_mmps))
    return uses


def _axis_use(name, state, command, target, period_ns: int, settling_speed_mmps: float) -> AxisUse:
    pressures = [state["chamber_1_pressure_pa"], state["chamber_2_pressure_pa"]]
    position_mm = state["rod_position_m"] / M_PER_MM
    speed_mmps = state["rod_velocity_mps"] / M_PER_MM
    valve = command["valve_command"] if command is not None else np.zeros(0)
    mode = command["mode"] if command is not None else np.zeros(0, np.uint8)
    same = command is not None and len(command) == len(state) and np.array_equal(command["tick"], state["tick"])
    settling = (
        settling_times_ms(state["tick"], valve, speed_mmps, period_ns, settling_speed_mmps)
        if same
        else np.zeros((0, 2))
    )
    active = mode == status.MODE_ACTIVE
    error_mm = np.zeros(0)
    if target is not None:
        error_mm = np.abs(position_mm - target / M_PER_MM)[active if same else slice(None)]
    settled = settling[settling[:, 1] > 0, 0]
    return AxisUse(
        name=name,
        pressure_mpa_min=float(min(p.min() for p in pressures) / PA_PER_MPA),
        pressure_mpa_max=float(max(p.max() for p in pressures) / PA_PER_MPA),
        position_mm_min=float(position_mm.min()),
        position_mm_max=float(position_mm.max()),
        speed_mmps_max=float(np.abs(speed_mmps).max()),
        command_min=float(valve.min()) if len(valve) else float("nan"),
        command_max=float(valve.max()) if len(valve) else float("nan"),
        flag_ticks=_count_flags(state["flags"]),
        mode_ticks={status.MODE_NAMES[k]: int(n) for k, n in enumerate(np.bincount(mode)) if n and k < 7},
        command_age_ms_max_active=float(command["age_ns"][active].max() / NS_PER_MS) if active.any() else 0.0,
        fail_safe_ms=_fail_safe_ms(command) if command is not None else [],
        stop_count=len(settling),
        settling_ms_max=float(settled.max()) if len(settled) else float("nan"),
        unsettled_count=int((settling[:, 1] == 0).sum()),
        tracking_mm_max=float(error_mm.max()) if len(error_mm) else float("nan"),
        tracking_mm_rms=float(np.sqrt(np.mean(error_mm**2))) if len(error_mm) else float("nan"),
        traces=_traces(state, valve if same else None, target, period_ns),
    )


def _count_flags(flags: np.ndarray) -> dict[str, int]:
    counts = {name: int(np.count_nonzero(flags >> bit & 1)) for bit, name in enumerate(status.FLAG_NAMES)}
    return {name: count for name, count in counts.items() if count}


def _fail_safe_ms(command: np.ndarray) -> list[float]:
    latched = command["mode"] == status.MODE_FAIL_SAFE
    entered = np.flatnonzero(latched & ~np.concatenate(([False], latched[:-1])))
    return [float(age / NS_PER_MS) for age in command["age_ns"][entered]]


def settling_times_ms(tick, valve, speed_mmps, period_ns: int, limit_mmps: float) -> np.ndarray:
    """Every stop of the valve: float64[stops, 2], settling time in ms and 1 if the rod came to stand, 0 if not.

    A stop begins when the command falls below half a percent after having been above 5 %, and counts when it stays there for
    0.2 s. The settling time runs to the last tick faster than `limit_mmps`; one that is still faster at the end did not settle.
    """
    neutral = np.abs(valve) < NEUTRAL_COMMAND
    edges = np.flatnonzero(np.diff(neutral.astype(np.int8), prepend=0))
    bounds = np.append(edges, len(neutral))
    rows = []
    moved_until = 0
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        if not neutral[start]:
            continue
        length_s = (int(tick[stop - 1]) - int(tick[start])) * period_ns * 1e-9
        if length_s < STOP_S_MIN:  # a chattering command has very many of these: nothing may be searched for them
            continue
        if start > 0 and np.abs(valve[moved_until:start]).max(initial=0.0) > MOVED_COMMAND:
            fast = np.flatnonzero(np.abs(speed_mmps[start:stop]) > limit_mmps)
            last = start + fast[-1] if len(fast) else start
            settled = not len(fast) or fast[-1] < stop - start - 1
            rows.append(((int(tick[last]) - int(tick[start])) * period_ns / NS_PER_MS, float(settled)))
        moved_until = stop
    return np.array(rows).reshape(-1, 2)


def _reference_m(state: np.ndarray, period_ns: int, axis: Axis | None, given: np.ndarray | None) -> np.ndarray | None:
    """Rod position that was to be followed, at every logged state; None where no reference is known."""
    times_s = state["tick"] * (period_ns * 1e-9)
    if given is not None:
        return np.interp(times_s, given[:, 0], given[:, 1])
    if axis is None or axis.wave is None or axis.load.kind != "knuckle-boom":
        return None
    rest_m = axis.initial_position_mm * M_PER_MM
    components = heave_components(axis.wave.significant_height_m, axis.wave.peak_period_s, axis.wave.seed)
    return rest_m - heave_series(components, times_s)[:, 0] / float(tip_ratio(Crane(), rest_m))


def _traces(state: np.ndarray, valve, target, period_ns: int, points: int = 1200) -> dict[str, np.ndarray]:
    """At most `points` samples of the motion for a plot."""
    pick = np.unique(np.linspace(0, len(state) - 1, min(points, len(state))).astype(np.int64))
    traces = {
        "time_s": state["tick"][pick] * (period_ns * 1e-9),
        "position_mm": state["rod_position_m"][pick] / M_PER_MM,
        "chamber_1_mpa": state["chamber_1_pressure_pa"][pick] / PA_PER_MPA,
        "chamber_2_mpa": state["chamber_2_pressure_pa"][pick] / PA_PER_MPA,
    }
    if valve is not None:
        traces["valve"] = valve[pick].astype(np.float64)
    if target is not None:
        traces["target_mm"] = target[pick] / M_PER_MM
    return traces
