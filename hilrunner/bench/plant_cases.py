"""The runs that certify the plant's solvers: one axis through a schedule under a load, with any engine and count of steps."""

from dataclasses import dataclass, replace

import numpy as np

from hilrunner.base import status
from hilrunner.plant import load, parameters, schedule, step

PERIOD_S = 1e-3


def plant(circuit: int = status.CIRCUIT_LIFT, preset: str | None = None, overrides=None, table=None, **fields):
    """An AxisPlant with the circuit's usual preset and load."""
    name = preset or ("paper" if circuit == status.CIRCUIT_PAPER else "lift")
    return step.AxisPlant(circuit, parameters.make_parameters(name, overrides), table or load.knuckle_boom(), **fields)


def run(axis_plant, commands, load_scales=None, start=None, position_m: float = 0.6, period_s: float = PERIOD_S):
    """(states (n, 10), flags (n,)) of one axis under commands held a period each."""
    commands = np.ascontiguousarray(commands, dtype=np.float64)
    count = len(commands)
    scales = np.ones(count) if load_scales is None else np.ascontiguousarray(load_scales, dtype=np.float64)
    state = step.initial_state(axis_plant, position_m) if start is None else np.array(start, dtype=np.float64)
    states, flags = np.zeros((count, 10)), np.zeros(count, np.int64)
    model = step.assemble([axis_plant], period_s)
    step.advance_many(model, 0, commands, scales, period_s, state, np.zeros(step.SCRATCH_SIZE), states, flags)
    return states, flags


def times(duration_s: float, period_s: float = PERIOD_S) -> np.ndarray:
    """Start of every period; s."""
    return np.arange(round(duration_s / period_s)) * period_s


@dataclass(frozen=True)
class Case:
    """One run of the certification."""

    name: str
    group: str  # which list of the certification it belongs to
    circuit: int
    schedule: str
    position_m: float
    load_n: float | None = None  # constant load; None: the knuckle boom
    wave_n: tuple[tuple[float, float], ...] = ()  # (amplitude N, frequency Hz) added to the load
    duration_s: float | None = None

    def plant(self, **fields):
        """Its AxisPlant."""
        table = None if self.load_n is None else load.constant(self.load_n)
        return plant(self.circuit, table=table, **fields)

    def commands(self) -> np.ndarray:
        """Valve commands, one a millisecond."""
        data = schedule.SCHEDULES[self.schedule]
        return schedule.sample(data, times(self.duration_s or data.duration_s))

    def load_scales(self) -> np.ndarray:
        """Load factors, one a millisecond."""
        t = times(len(self.commands()) * PERIOD_S)
        base = self.load_n if self.load_n is not None else 650e3
        added = sum((amplitude * np.sin(2.0 * np.pi * hz * t) for amplitude, hz in self.wave_n), np.zeros(len(t)))
        return 1.0 + added / base

    def start(self) -> np.ndarray:
        """State at rest."""
        return step.initial_state(self.plant(), self.position_m, 0.0, float(self.load_scales()[0]))

    def shortened(self, duration_s: float) -> "Case":
        """The same, cut off."""
        return replace(self, duration_s=duration_s)


PAPER, LIFT, LINES = status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES
_SWELL = ((100e3, 0.5), (40e3, 1.3))
_SMALL_SWELL = ((60e3, 0.5), (25e3, 1.3))

LIFT_20S, LIFT_2MS, OVERRUN, CYCLE_60S = (
    "20 s lift",
    "20 s lift, 2 ms ramps",
    "overrunning",
    "60 s lift-hold-lower-hold",
)
JUMPS = "jumps of the command"  # beyond what is demanded: up to its whole range from one millisecond to the next

CASES: tuple[Case, ...] = (
    Case("paper: 20 s lift", LIFT_20S, PAPER, "lift-profile", 0.3),
    Case("lift: 20 s lift", LIFT_20S, LIFT, "lift-profile", 0.3),
    Case("lift-lines: 20 s lift", LIFT_20S, LINES, "lift-profile", 0.3),
    Case("paper: 2 ms ramps", LIFT_2MS, PAPER, "lift-profile-2ms", 0.3),
    Case("lift: 2 ms ramps", LIFT_2MS, LIFT, "lift-profile-2ms", 0.3),
    Case("lift-lines: 2 ms ramps", LIFT_2MS, LINES, "lift-profile-2ms", 0.3),
    Case("paper: overrunning -350 kN", OVERRUN, PAPER, "overrun", 0.3, -350e3),
    Case("paper: overrunning -250 kN, waves", OVERRUN, PAPER, "overrun", 0.3, -250e3, _SWELL),
    Case("lift: overrunning -150 kN, waves", OVERRUN, LIFT, "lift-hold-lower-hold", 0.6, -150e3, _SMALL_SWELL),
    Case("lift-lines: overrunning -150 kN, waves", OVERRUN, LINES, "lift-hold-lower-hold", 0.6, -150e3, _SMALL_SWELL),
    Case("lift: lift-hold-lower-hold", CYCLE_60S, LIFT, "lift-hold-lower-hold", 0.6),
    Case("lift: lift-hold-lower-hold, waves", CYCLE_60S, LIFT, "lift-hold-lower-hold", 0.6, None, _SWELL),
    Case("lift-lines: lift-hold-lower-hold", CYCLE_60S, LINES, "lift-hold-lower-hold", 0.6),
    Case("paper: steps", JUMPS, PAPER, "steps", 0.6),
    Case("lift: steps", JUMPS, LIFT, "steps", 0.6),
    Case("lift-lines: steps", JUMPS, LINES, "steps", 0.6),
)


def case_named(name: str) -> Case:
    """One of CASES."""
    return next(case for case in CASES if case.name == name)
