"""What is run: a plant, held commands, held load factors and a state to start from; one period is 1 ms."""

from dataclasses import dataclass, replace

import numpy as np

from hilrunner.base import status
from hilrunner.plant.load import Crane, constant, perturbed, tip_ratio
from hilrunner.plant.schedule import SCHEDULES, Ramps, sample
from hilrunner.plant.step import AxisPlant, initial_state
from hilrunner.plant.wave import heave_series, load_scale_series
from hilrunner.reproduce.models import PERIOD_S, reference_of
from hilrunner.setup.axes import make_waves
from hilrunner.setup.profile import load_profile

PERTURBED_STD_RATIO, PERTURBED_SEED = 0.02, 5  # of the article's Gaussian disturbance only the kind is known
LIFT_START_M, PAPER_START_M = 0.6, 0.3
_FULL_SPEED_MPS = 0.0225  # rod at command 1 or -1, to turn a wanted speed into a command


@dataclass(frozen=True, eq=False)
class Case:
    """One run, the same for every engine.

    Args:
        key: for machines; title: for people, without the length. plant: complete first-principle plant.
        commands, load_scales: float64[n], held a period each. start: float64[10], base.state_layout.
    """

    key: str
    title: str
    plant: AxisPlant
    commands: np.ndarray
    load_scales: np.ndarray
    start: np.ndarray

    @property
    def duration_s(self) -> float:
        """How long it is."""
        return len(self.commands) * PERIOD_S

    @property
    def words(self) -> str:
        """What it is and how long."""
        return f"{self.title}, {self.duration_s:g} s"

    @property
    def times_s(self) -> np.ndarray:
        """Ends of the periods, float64[n]."""
        return (np.arange(len(self.commands)) + 1.0) * PERIOD_S

    def shortened(self, seconds: float) -> "Case":
        """The same, cut off."""
        count = min(len(self.commands), round(seconds / PERIOD_S))
        return replace(self, commands=self.commands[:count], load_scales=self.load_scales[:count])


def _times(seconds: float) -> np.ndarray:
    return np.arange(round(seconds / PERIOD_S)) * PERIOD_S


def case_of(key: str, title: str, plant: AxisPlant, commands, start_m: float, scales=None) -> Case:
    """A case from rest at a rod position."""
    held = np.ascontiguousarray(commands, np.float64)
    factors = np.ones(len(held)) if scales is None else np.ascontiguousarray(scales, np.float64)
    return Case(key, title, plant, held, factors, initial_state(plant, start_m, 0.0, float(factors[0])))


def paper_lift(disturbed: bool) -> Case:
    """The article's experiment: 20 s of lifting, nominal load (Figures 5 to 8) or perturbed (Figures 9 to 11)."""
    plant = reference_of("paper")
    if disturbed:
        plant = replace(plant, load=perturbed(plant.load, PERTURBED_STD_RATIO, PERTURBED_SEED))
    schedule = SCHEDULES["lift-profile"]
    key, words = ("perturbed", "perturbed load") if disturbed else ("nominal", "nominal load")
    commands = sample(schedule, _times(schedule.duration_s))
    return case_of(key, f"circuit paper, lift, {words}", plant, commands, PAPER_START_M)


def paper_overrun() -> Case:
    """The article's circuit under a load that pulls: its counterbalance valve modulates, which the article never tries."""
    # chamber 2 stays below the 4 MPa up to which the network was trained
    plant = replace(reference_of("paper"), load=constant(-60e3))
    schedule = SCHEDULES["overrun"]
    commands = sample(schedule, _times(schedule.duration_s))
    title = "circuit paper, pulled out by 60 kN"
    return case_of("paper_overrun", title, plant, commands, PAPER_START_M)


def lift_hold_lower_hold() -> Case:
    """60 s: lift, hold, lower, hold; profile amc-lift."""
    schedule = SCHEDULES["lift-hold-lower-hold"]
    commands = sample(schedule, _times(schedule.duration_s))
    title = "circuit lift, lift-hold-lower-hold"
    return case_of("schedule", title, reference_of("amc-lift"), commands, LIFT_START_M)


def wave() -> Case:
    """120 s in the sea of profile wave-hs05: 60 s of its schedule, then 60 s of commands that keep the hook still."""
    components = make_waves(load_profile("wave-hs05"))[0]
    schedule = SCHEDULES["lift-hold-lower-hold"]
    times = _times(2.0 * schedule.duration_s)
    commands = sample(schedule, times)
    rise = float(tip_ratio(Crane(), LIFT_START_M))
    late = times >= schedule.duration_s
    speed = -heave_series(components, times[late])[:, 1] / rise
    commands[late] = np.clip(speed / _FULL_SPEED_MPS, -1.0, 1.0)
    title = "circuit lift, sea of Hs 0.5 m: schedule, then heave compensation"
    return case_of(
        "sea", title, reference_of("wave-hs05"), commands, LIFT_START_M, load_scale_series(components, times)
    )


def overrunning() -> Case:
    """60 s of profile overrunning: 150 kN pull the rod out, in a sea of Hs 1 m; the rod-side valve modulates."""
    components = make_waves(load_profile("overrunning"))[0]
    schedule = SCHEDULES["lift-hold-lower-hold"]
    times = _times(schedule.duration_s)
    title = "circuit lift, pulled out by 150 kN in a sea of Hs 1 m"
    return case_of(
        "overrunning",
        title,
        reference_of("overrunning"),
        sample(schedule, times),
        LIFT_START_M,
        load_scale_series(components, times),
    )


def random_schedule(random: np.random.Generator, seconds: float, lowest: float) -> Ramps:
    """Smooth changes between random commands of `lowest` to 1, a quarter of them to neutral."""
    ramps, level, at = [], 0.0, 0.2 + 0.3 * random.random()
    while at < seconds - 0.5:
        target = 0.0 if random.random() < 0.25 else random.uniform(lowest, 1.0)
        length = random.uniform(0.05, 0.5)
        ramps.append((at, length, target - level))
        level = target
        at += length + random.uniform(0.5, 2.5)
    return Ramps(seconds, tuple(ramps))


def held_out(profile: str, number: int, seconds: float) -> tuple[Case, float, float]:
    """Run `number` of the held-out ones: (case, load factor, start in m), all drawn from the number as a seed."""
    random = np.random.default_rng([20_250_702, number])
    plant = reference_of(profile)
    lowest = 0.0 if plant.circuit == status.CIRCUIT_PAPER else -1.0
    scale, start_m = random.uniform(0.7, 1.1), random.uniform(0.2, 1.0)
    commands = sample(random_schedule(random, seconds, lowest), _times(seconds))
    key = f"held_out_{status.CIRCUIT_NAMES[plant.circuit]}_{number}"
    case = case_of(key, key, plant, commands, start_m, np.full(len(commands), scale))
    return case, scale, start_m
