"""How right the plant's solvers are: their order, whole runs against SUNDIALS IDA, and an hour of holding a load.

Each part yields rows as they are measured; a row that must hold carries limits. Nothing here is timed.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from hilrunner.base import status
from hilrunner.base.state_layout import CHAMBER_1_PRESSURE, CHAMBER_2_PRESSURE, ROD_POSITION, ROD_VELOCITY
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.bench import plant_cases
from hilrunner.bench.plant_cases import PERIOD_S, Case
from hilrunner.plant import ida, step
from hilrunner.setup.axes import truth_substep_count

CERTIFIED_RTOL = 1e-11
TRUTH_MPA, TRUTH_MM = 1e-6, 1e-6  # the compiled reference that judges others, against IDA
MASS_FREE_MPA = 1e-3
# the loop's reference, in steps as long as stability allows
LOOP_MPA = {status.CIRCUIT_PAPER: 1e-6, status.CIRCUIT_LIFT: 1e-5, status.CIRCUIT_LIFT_LINES: 1e-6}
ORDER, ORDER_BAND = 4.0, 0.1
DRIFT_MM = 1e-3
OIL_RATIO = 1e-9
_ORDER_COUNTS = (16, 20, 25, 32)
_ORDER_TRUTH_COUNT = 320
_FINE_COUNTS = (40, 80)
_HOLD_BLOCK_S = 60.0
_BOUNCE_M_S = -0.02
_PRESSURES = [CHAMBER_1_PRESSURE, CHAMBER_2_PRESSURE]

Progress = Callable[[str, float], None]  # (what is being done, share 0..1)


@dataclass(frozen=True)
class Figure:
    """One number; `limit` None: told, not demanded. `low` is a lower bound where there is one."""

    name: str
    value: float
    unit: str
    limit: float | None = None
    low: float | None = None

    @property
    def met(self) -> bool:
        """Within its limits; a number that is none is not."""
        above = self.limit is None or self.value <= self.limit
        return math.isfinite(self.value) and above and (self.low is None or self.value >= self.low)


@dataclass(frozen=True)
class Row:
    """One measurement: which part and run, what was compared, and its figures."""

    part: str
    case: str
    compared: str
    figures: tuple[Figure, ...]

    @property
    def met(self) -> bool | None:
        """Every demand holds; None where nothing is demanded."""
        demanded = [figure for figure in self.figures if figure.limit is not None]
        return all(figure.met for figure in demanded) if demanded else None

    def as_dict(self) -> dict:
        """For JSON; keys end in units."""
        found = {_key(figure): figure.value for figure in self.figures}
        limits = {_key(figure): figure.limit for figure in self.figures if figure.limit is not None}
        return {
            "part": self.part,
            "case": self.case,
            "compared": self.compared,
            **found,
            "limits": limits,
            "met": self.met,
        }


def _key(figure: Figure) -> str:
    words = f"{figure.name} {figure.unit}".strip().lower()
    return words.replace("/", "p").replace(" ", "_")


# convergence


def order_rows(progress: Progress) -> Iterator[Row]:
    """Order of RK4, which is the compiled reference too, on every circuit: least squares over four step lengths.

    20 ms of the ringing oil column, from the middle of a motion and away from every kink; errors of the pressures
    against 320 steps a millisecond.
    """
    variants = [
        (circuit, fast)
        for circuit in range(len(status.CIRCUIT_NAMES))
        for fast in (False, True)
        if not (fast and circuit == status.CIRCUIT_LIFT_LINES)
    ]
    for index, (circuit, fast) in enumerate(variants):
        progress("order of convergence", index / len(variants))
        order, errors = convergence_order(circuit, fast)
        name = status.CIRCUIT_NAMES[circuit] + (", mass-free spools" if fast else "")
        figures = (
            Figure("order", order, "", ORDER + ORDER_BAND, ORDER - ORDER_BAND),
            Figure("coarsest", errors[0] / PA_PER_MPA, "MPa"),
            Figure("finest", errors[-1] / PA_PER_MPA, "MPa"),
        )
        yield Row("order", name, f"RK4 x{_ORDER_COUNTS[0]} to x{_ORDER_COUNTS[-1]} a ms", figures)


def convergence_order(circuit: int, fast: bool) -> tuple[float, list[float]]:
    """(order, RMS pressure error of each step length, Pa)."""
    warm = plant_cases.plant(circuit, fast=fast, substep_count=200)
    start = plant_cases.run(warm, np.full(100, 0.5))[0][-1]
    held = np.full(20, 0.55)  # the check valve stays half open: no kink within the run

    def pressures(count: int) -> np.ndarray:
        plant = plant_cases.plant(circuit, fast=fast, substep_count=count)
        return plant_cases.run(plant, held, start=start)[0][:, _PRESSURES]

    exact = pressures(_ORDER_TRUTH_COUNT)
    errors = [float(np.sqrt(np.mean((pressures(count) - exact) ** 2))) for count in _ORDER_COUNTS]
    return float(-np.polyfit(np.log(_ORDER_COUNTS), np.log(errors), 1)[0]), errors


# whole runs against IDA


def solver_rows(case: Case, progress: Progress) -> Iterator[Row]:
    """One run: the compiled references against IDA, and IDA against Richardson's extrapolation of RK4."""
    commands, scales, start = case.commands(), case.load_scales(), case.start()
    plant, total = case.plant(), len(commands)
    truth = ida.solve_ida(
        plant,
        commands,
        scales,
        PERIOD_S,
        start,
        rtol=CERTIFIED_RTOL,
        progress=lambda done: progress(f"IDA, {case.name}", done / total),
    )

    def compared(name: str, states: np.ndarray, limit_mpa: float | None, limit_mm: float | None = None) -> Row:
        worst = np.abs(states - truth).max(axis=0)
        return Row(case.group, case.name, f"{name} - IDA", _errors(worst, limit_mpa, limit_mm))

    def advanced(count: int, fast: bool = False) -> np.ndarray:
        return plant_cases.run(case.plant(substep_count=count, fast=fast), commands, scales, start)[0]

    judge, loop = truth_substep_count(plant, PERIOD_S), step.default_substep_count(plant, PERIOD_S)
    demanded = case.group != plant_cases.JUMPS
    truth_limits = (TRUTH_MPA, TRUTH_MM) if demanded else (None, None)
    yield compared(f"reference that judges, RK4 x{judge}", advanced(judge), *truth_limits)
    yield compared(f"reference in the loop, RK4 x{loop}", advanced(loop), LOOP_MPA[case.circuit] if demanded else None)
    if case.circuit != status.CIRCUIT_LIFT_LINES:
        fast = step.default_substep_count(case.plant(fast=True), PERIOD_S)
        yield compared(f"mass-free spools, RK4 x{fast}", advanced(fast, True), MASS_FREE_MPA if demanded else None)
    coarse, fine = (advanced(count) for count in _FINE_COUNTS)
    yield compared("Richardson of RK4 x{} and x{}".format(*_FINE_COUNTS), fine + (fine - coarse) / 15.0, None)


def _errors(worst: np.ndarray, limit_mpa: float | None, limit_mm: float | None) -> tuple[Figure, ...]:
    return (
        Figure("p1", float(worst[CHAMBER_1_PRESSURE]) / PA_PER_MPA, "MPa", limit_mpa),
        Figure("p2", float(worst[CHAMBER_2_PRESSURE]) / PA_PER_MPA, "MPa", limit_mpa),
        Figure("x", float(worst[ROD_POSITION]) / M_PER_MM, "mm", limit_mm),
    )


# an hour of holding


def hold_rows(duration_s: float, progress: Progress) -> Iterator[Row]:
    """A load held with the valve shut, after a bounce: drift of the rod once it rests, oil of both chambers throughout."""
    for circuit, name in enumerate(status.CIRCUIT_NAMES):
        plant = plant_cases.plant(circuit)
        count = step.default_substep_count(plant, PERIOD_S)
        drift_mm, oil_ratio, bounce_mm = hold(
            plant, duration_s, lambda share, name=name: progress(f"hold, {name}", share)
        )
        figures = (
            Figure("drift", drift_mm, "mm", DRIFT_MM),
            Figure("oil lost", oil_ratio, "ratio", OIL_RATIO),
            Figure("bounce", bounce_mm, "mm"),
        )
        yield Row("hold", f"{name}: valve shut, {duration_s:g} s", f"RK4 x{count} - its own start", figures)


def hold(
    axis_plant, duration_s: float, progress: Callable[[float], None], start: np.ndarray | None = None
) -> tuple[float, float, float]:
    """`duration_s` in whole minutes, two or more: (travel of the rod after the first, mm; largest relative change of a chamber's oil; travel before, mm)."""
    model = step.assemble([axis_plant], PERIOD_S)
    state = step.initial_state(axis_plant, 0.6) if start is None else start.copy()
    state[ROD_VELOCITY] = _BOUNCE_M_S
    block = round(_HOLD_BLOCK_S / PERIOD_S)
    states, flags, scratch = np.zeros((block, 10)), np.zeros(block, np.int64), np.zeros(step.SCRATCH_SIZE)
    oil = oil_mass(axis_plant.parameters[0], state[None, :].copy())
    held, scales, lost = np.zeros(block), np.ones(block), 0.0
    bounce_m, low, high = 0.0, math.inf, -math.inf
    count = max(2, round(duration_s / _HOLD_BLOCK_S))
    for index in range(count):
        step.advance_many(model, 0, held, scales, PERIOD_S, state, scratch, states, flags)
        now = oil_mass(axis_plant.parameters[0], states)
        lost = max(lost, *(float(np.abs(one / first[0] - 1.0).max()) for one, first in zip(now, oil, strict=True)))
        x = states[:, ROD_POSITION]
        if index == 0:
            bounce_m = float(np.ptp(x))
        else:
            low, high = min(low, float(x.min())), max(high, float(x.max()))
        progress((index + 1) / count)
    return (high - low) / M_PER_MM, lost, bounce_m / M_PER_MM


def oil_mass(prm, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Oil of both chambers at constant bulk modulus, V exp(p / beta); relative units."""
    x, beta = states[:, ROD_POSITION], prm["bulk_modulus_pa"]
    volume_1 = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * x
    volume_2 = prm["dead_volume_2_m3"] + prm["rod_side_area_m2"] * (prm["stroke_m"] - x)
    return volume_1 * np.exp(states[:, CHAMBER_1_PRESSURE] / beta), volume_2 * np.exp(
        states[:, CHAMBER_2_PRESSURE] / beta
    )


def certify(cases: Iterable[Case], hold_s: float, progress: Progress) -> Iterator[Row]:
    """Every row: order, each run, holding."""
    yield from order_rows(progress)
    for case in cases:
        yield from solver_rows(case, progress)
    yield from hold_rows(hold_s, progress)
