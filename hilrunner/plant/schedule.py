"""Valve commands over time as data: ramps, tables, chirps and pseudo-random steps; files with them are read in setup."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Ramps:
    """A sum of smooth changes: from `start`, each (begin_s, length_s, change); length 0 is a step."""

    duration_s: float
    ramps: tuple[tuple[float, float, float], ...]
    start: float = 0.0

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t; s."""
        total = np.full_like(t, self.start)
        for begin, length, change in self.ramps:
            if length <= 0.0:
                total += change * (t >= begin)
            else:
                s = np.clip((t - begin) / length, 0.0, 1.0)
                total += change * s**3 * (10.0 + s * (-15.0 + 6.0 * s))
        return total


@dataclass(frozen=True)
class Table:
    """Values at times, held until the next time or joined by straight lines."""

    duration_s: float
    times_s: tuple[float, ...]
    commands: tuple[float, ...]
    linear: bool = False

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t; before the first time the first value, after the last the last."""
        if self.linear:
            return np.interp(t, self.times_s, self.commands)
        index = np.searchsorted(self.times_s, t, side="right") - 1
        return np.asarray(self.commands)[np.maximum(index, 0)]


@dataclass(frozen=True)
class Chirp:
    """offset + amplitude sin(phase), frequency rising exponentially from start to end over the duration."""

    duration_s: float
    start_hz: float
    end_hz: float
    amplitude: float
    offset: float = 0.0

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t."""
        rate = math.log(self.end_hz / self.start_hz) / self.duration_s
        if rate == 0.0:
            return self.offset + self.amplitude * np.sin(2.0 * math.pi * self.start_hz * t)
        return self.offset + self.amplitude * np.sin(2.0 * math.pi * self.start_hz / rate * np.expm1(rate * t))


@dataclass(frozen=True)
class RandomSteps:
    """Pseudo-random binary sequence: low or high, drawn anew every dwell time."""

    duration_s: float
    dwell_s: float
    low: float
    high: float
    seed: int = 1

    def values(self, t: np.ndarray) -> np.ndarray:
        """Commands at times t."""
        count = math.ceil(self.duration_s / self.dwell_s) + 1
        bits = np.random.default_rng(self.seed).integers(0, 2, count)
        index = np.clip((t / self.dwell_s).astype(np.int64), 0, count - 1)
        return np.where(bits[index] == 1, self.high, self.low).astype(np.float64)


Schedule = Ramps | Table | Chirp | RandomSteps

# the article's Figure 6 as far as its text tells it: commands 0, .5, 1, .3, .8, 0, .6, 0 (docs/paper.md)
_LIFT = (
    (0.5, 0.30, 0.5),
    (4.0, 0.20, 0.5),
    (8.0, 0.20, -0.7),
    (11.0, 1.0, 0.5),
    (14.5, 0.10, -0.8),
    (16.5, 0.05, 0.6),
    (19.0, 0.30, -0.6),
)
_LIFT_2MS = tuple((begin, length if length == 1.0 else 0.002, change) for begin, length, change in _LIFT)

SCHEDULES: dict[str, Schedule] = {
    "lift-profile": Ramps(20.0, _LIFT),
    "lift-profile-2ms": Ramps(20.0, _LIFT_2MS),
    "lift-hold-lower-hold": Ramps(
        60.0,
        (
            (1.0, 0.3, 0.6),
            (10.0, 0.2, 0.4),
            (18.0, 0.3, -1.0),
            (30.0, 0.3, -0.5),
            (40.0, 0.3, -0.5),
            (50.0, 0.5, 1.0),
        ),
    ),
    "overrun": Ramps(20.0, ((0.5, 0.3, 0.3), (6.0, 0.2, 0.3), (12.0, 0.1, 0.4), (16.0, 0.3, -1.0))),
    "steps": Ramps(12.0, ((1.0, 0.0, 0.5), (3.0, 0.0, 0.5), (5.0, 0.0, -1.0), (7.0, 0.0, -0.5), (10.0, 0.0, 0.5))),
    "chirp": Chirp(20.0, 0.1, 10.0, 0.4),
    "prbs": RandomSteps(20.0, 0.25, -0.5, 0.6),
    "hold": Ramps(60.0, ()),
    "full-lift": Ramps(30.0, ((0.5, 0.3, 1.0),)),
    "full-lower": Ramps(30.0, ((0.5, 0.3, -1.0),)),
}


def sample(schedule: Schedule, times_s: np.ndarray) -> np.ndarray:
    """(n,) float64 commands at (n,) times, clipped to -1..1."""
    return np.clip(schedule.values(np.asarray(times_s, dtype=np.float64)), -1.0, 1.0)
