"""What the actuator did in a run: ranges, flags, stops, fail-safes, distance from the reference motion."""

import math
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
    heard_ticks: int  # at which the newest valid command was known, or one was applied
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
        target = reference_m(state["tick"], facts.period_ns, profiles.get(name), given)
        tally = AxisTally(name, facts.period_ns, settling_speed_mmps)
        tally.take(state, command, target)
        same = command is not None and np.array_equal(command["tick"], state["tick"])
        valve = command["valve_command"] if same else None
        uses.append(tally.result(_traces(state, valve, target, facts.period_ns)))
    return uses


class AxisTally:
    """Sums the use of one axis batch by batch, so that a run of days needs no more memory than one of minutes."""

    def __init__(self, name: str, period_ns: int, settling_speed_mmps: float) -> None:
        self._name = name
        self._stops = SettlingTally(period_ns, settling_speed_mmps)
        self._low = dict.fromkeys(("pressure", "position", "command"), math.inf)
        self._high = dict.fromkeys(("pressure", "position", "command", "speed"), -math.inf)
        self._flags = np.zeros(len(status.FLAG_NAMES), np.int64)
        self._modes = np.zeros(len(status.MODE_NAMES), np.int64)
        self._age_ns_max_active = 0
        self._heard_ticks = 0
        self._latched = False
        self._fail_safe_ms: list[float] = []
        self._error_mm_max, self._error_squares, self._error_count = 0.0, 0.0, 0

    def take(self, state: np.ndarray, command: np.ndarray | None, target_m: np.ndarray | None) -> None:
        """One batch of STATE and COMMAND rows (at least the fields of evidence.report.COLUMNS), in order of tick.

        Args:
            command: None where the log has none. Stops are found only where its ticks are those of the states.
            target_m: float64[len(state)], rod position to follow, m; None: none is known.
        """
        self._take_state(state)
        if command is not None:
            self._take_command(command)
        same = command is not None and np.array_equal(command["tick"], state["tick"])
        if same:
            self._stops.take(state["tick"], command["valve_command"], state["rod_velocity_mps"] / M_PER_MM)
        if target_m is not None:
            active = command["mode"] == status.MODE_ACTIVE if same else slice(None)
            self._take_distance(np.abs(state["rod_position_m"] - target_m)[active] / M_PER_MM)

    def _take_state(self, state: np.ndarray) -> None:
        for place in ("chamber_1_pressure_pa", "chamber_2_pressure_pa"):
            self._span("pressure", state[place] / PA_PER_MPA)
        self._span("position", state["rod_position_m"] / M_PER_MM)
        self._high["speed"] = max(self._high["speed"], float(np.abs(state["rod_velocity_mps"]).max() / M_PER_MM))
        for bit in range(len(self._flags)):
            self._flags[bit] += np.count_nonzero(state["flags"] >> bit & 1)

    def _take_command(self, command: np.ndarray) -> None:
        if not len(command):
            return
        mode, age_ns = command["mode"], command["age_ns"]
        active = mode == status.MODE_ACTIVE
        self._span("command", command["valve_command"])
        self._modes += np.bincount(np.minimum(mode, len(self._modes)), minlength=len(self._modes) + 1)[:-1]
        self._heard_ticks += int((active | (age_ns >= 0)).sum())
        if active.any():
            self._age_ns_max_active = max(self._age_ns_max_active, int(age_ns[active].max()))
        latched = mode == status.MODE_FAIL_SAFE
        entered = np.flatnonzero(latched & ~np.concatenate(([self._latched], latched[:-1])))
        self._fail_safe_ms += [float(age / NS_PER_MS) for age in age_ns[entered]]
        self._latched = bool(latched[-1])

    def _take_distance(self, error_mm: np.ndarray) -> None:
        if len(error_mm):
            self._error_mm_max = max(self._error_mm_max, float(error_mm.max()))
            self._error_squares += float(np.square(error_mm).sum())
            self._error_count += len(error_mm)

    def _span(self, name: str, values: np.ndarray) -> None:
        self._low[name] = min(self._low[name], float(values.min()))
        self._high[name] = max(self._high[name], float(values.max()))

    def result(self, traces: dict[str, np.ndarray] | None = None) -> AxisUse:
        """What was summed, at least one state."""
        settling = self._stops.rows()
        settled = settling[settling[:, 1] > 0, 0]
        commanded = self._low["command"] <= self._high["command"]
        known = self._error_count > 0
        return AxisUse(
            name=self._name,
            pressure_mpa_min=self._low["pressure"],
            pressure_mpa_max=self._high["pressure"],
            position_mm_min=self._low["position"],
            position_mm_max=self._high["position"],
            speed_mmps_max=self._high["speed"],
            command_min=self._low["command"] if commanded else math.nan,
            command_max=self._high["command"] if commanded else math.nan,
            flag_ticks={name: int(n) for name, n in zip(status.FLAG_NAMES, self._flags, strict=True) if n},
            mode_ticks={name: int(n) for name, n in zip(status.MODE_NAMES, self._modes, strict=True) if n},
            command_age_ms_max_active=self._age_ns_max_active / NS_PER_MS,
            heard_ticks=self._heard_ticks,
            fail_safe_ms=list(self._fail_safe_ms),
            stop_count=len(settling),
            settling_ms_max=float(settled.max()) if len(settled) else math.nan,
            unsettled_count=int((settling[:, 1] == 0).sum()),
            tracking_mm_max=self._error_mm_max if known else math.nan,
            tracking_mm_rms=math.sqrt(self._error_squares / self._error_count) if known else math.nan,
            traces=traces or {},
        )


class SettlingTally:
    """Every stop of the valve, found batch by batch.

    A stop begins when the command falls below half a percent after having been above 5 %, and counts when it stays there for
    0.2 s. The settling time runs to the last tick faster than the limit; one that is still faster at the end did not settle.
    """

    def __init__(self, period_ns: int, limit_mmps: float) -> None:
        self._period_ns = period_ns
        self._limit_mmps = limit_mmps
        self._rows: list[tuple[float, float]] = []
        self._moved_to = 0.0  # largest command since the last stop
        # the stretch at neutral that is going on: first and last tick, last fast tick, whether the last tick was fast, a stop
        self._neutral: tuple[int, int, int, bool, bool] | None = None

    def take(self, tick: np.ndarray, valve: np.ndarray, speed_mmps: np.ndarray) -> None:
        """One batch: ticks in order, commands -1..1, speeds in mm/s, all (n,)."""
        neutral = np.abs(valve) < NEUTRAL_COMMAND
        bounds = [0, *(np.flatnonzero(np.diff(neutral.astype(np.int8))) + 1).tolist(), len(neutral)]
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
            if stop == start:
                continue
            if not neutral[start]:
                self._rows += self._closed()
                self._neutral = None
                self._moved_to = max(self._moved_to, float(np.abs(valve[start:stop]).max()))
                continue
            first, _, last_fast, _, is_stop = self._neutral or (
                int(tick[start]),
                0,
                -1,
                False,
                self._moved_to > MOVED_COMMAND,
            )
            fast = np.flatnonzero(np.abs(speed_mmps[start:stop]) > self._limit_mmps)
            if len(fast):
                last_fast = int(tick[start + fast[-1]])
            ends_fast = len(fast) > 0 and int(fast[-1]) == stop - start - 1
            self._neutral = (first, int(tick[stop - 1]), last_fast, ends_fast, is_stop)
            if (self._neutral[1] - first) * self._period_ns * 1e-9 >= STOP_S_MIN:
                self._moved_to = 0.0

    def rows(self) -> np.ndarray:
        """float64[stops, 2]: settling time in ms, and 1 if the rod came to stand, 0 if not."""
        return np.array(self._rows + self._closed()).reshape(-1, 2)

    def _closed(self) -> list[tuple[float, float]]:
        """The stop that the stretch going on is, if it ended now."""
        if self._neutral is None:
            return []
        first, last, last_fast, ends_fast, is_stop = self._neutral
        if not is_stop or (last - first) * self._period_ns * 1e-9 < STOP_S_MIN:
            return []
        return [(max(last_fast - first, 0) * self._period_ns / NS_PER_MS, float(not ends_fast))]


def settling_times_ms(tick, valve, speed_mmps, period_ns: int, limit_mmps: float) -> np.ndarray:
    """Every stop of the valve in whole arrays, as SettlingTally finds them."""
    tally = SettlingTally(period_ns, limit_mmps)
    tally.take(tick, valve, speed_mmps)
    return tally.rows()


def reference_m(tick: np.ndarray, period_ns: int, axis: Axis | None, given: np.ndarray | None) -> np.ndarray | None:
    """Rod position that was to be followed at each tick, m; None where no reference is known."""
    times_s = tick * (period_ns * 1e-9)
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
