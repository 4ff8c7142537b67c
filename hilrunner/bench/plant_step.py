"""What 1 ms of the plant costs and how wrong it is: surrogate, compiled references, Rosenbrock, SUNDIALS IDA, scipy Radau.

Every engine gets the same held commands from the same state: jumps of the command by up to half its range. Errors are against
the compiled reference at eight times its substeps (itself certified against IDA by tools/certify_plant).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilrunner.base import status
from hilrunner.base.state_layout import CHAMBER_1_PRESSURE, CHAMBER_2_PRESSURE, ROD_POSITION
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.bench.plant_cases import PERIOD_S
from hilrunner.bench.results import Table
from hilrunner.bench.rosenbrock import Rosenbrock
from hilrunner.bench.turns import fingerprint, median_ratio, time_turns
from hilrunner.plant.step import SCRATCH_SIZE, AxisPlant, advance_many, assemble, default_substep_count, initial_state
from hilrunner.plant.surrogate import EXACT_AT, SERVED_AT
from hilrunner.setup.axes import truth_substep_count

PERIODS = 1000
RADAU_PERIODS = 20
PAPER_SURROGATE_NS, PAPER_REFERENCE_NS = 201_100.0, 4_310_300.0  # shared article: 0.2011 ms and 4.3103 ms a step
SURROGATE, EXACT, MASS_FREE = "surrogate", "exact", "mass-free spools"
# what 1 ms of a compiled first-principle model may cost, us, and at which pressure error, MPa; half the cost is the aim
ALLOWED = {
    ("paper", EXACT): (8.0, 1e-6),
    ("lift", EXACT): (15.0, 1e-5),
    ("lift-lines", EXACT): (16.0, 1e-6),
    ("paper", MASS_FREE): (6.0, 1e-3),
    ("lift", MASS_FREE): (6.0, 1e-3),
}
_ROSENBROCK_COUNTS = (4, 6, 8, 12, 16, 24, 32, 48, 64)
_TRUTH_FACTOR = 8
_START_M = 0.6
_TYPICAL = np.array(
    [1.0, 0.01, 1e6, 1e6, 1e-3, 1e-3, 0.1, 0.1, 1e6, 1e6]
)  # state, SI: absolute tolerance per relative one


@dataclass(frozen=True)
class Case:
    """One engine on one problem: how to run all periods, and what it must be compared with."""

    name: str
    run: Callable[[], np.ndarray]  # one pass over the periods: float64[n, 10]
    periods: int = PERIODS


def commands(circuit: int) -> np.ndarray:
    """One second of held commands: lift, faster, hold, and lower where the circuit can; float64[PERIODS]."""
    values = np.zeros(PERIODS)
    values[5:300] = 0.4
    values[300:500] = 0.8
    if circuit != status.CIRCUIT_PAPER:
        values[600:900] = -0.5
    return values


class Advance:
    """All periods of one compiled plant from its initial state; call it for the states, float64[n, 10]."""

    def __init__(self, plant: AxisPlant, held: np.ndarray, period_s: float = PERIOD_S) -> None:
        self._model = assemble([plant], period_s)
        self._start = initial_state(plant, _START_M)
        self._held, self._period_s = held, period_s
        self._scratch, self._states = np.zeros(SCRATCH_SIZE), np.zeros((len(held), 10))
        self._scales, self._flags = np.ones(len(held)), np.zeros(len(held), np.int64)

    def __call__(self) -> np.ndarray:
        start, scratch = self._start.copy(), self._scratch
        arguments = (
            self._model,
            0,
            self._held,
            self._scales,
            self._period_s,
            start,
            scratch,
            self._states,
            self._flags,
        )
        advance_many(*arguments)
        return self._states

    def served_ratio(self) -> float:
        """Share of the line or flow evaluations that networks answered so far; the rest was solved exactly."""
        served, exact = self._scratch[SERVED_AT], self._scratch[EXACT_AT]
        return float(served / max(served + exact, 1.0))


def _ida(plant: AxisPlant, held: np.ndarray, rtol: float) -> Callable[[], np.ndarray]:
    from hilrunner.plant.ida import solve_ida

    start = initial_state(plant, _START_M)
    return lambda: solve_ida(plant, held, np.ones(len(held)), PERIOD_S, start, rtol=rtol)


def _radau(plant: AxisPlant, held: np.ndarray, rtol: float) -> Callable[[], np.ndarray]:
    """scipy's Radau restarted each period, as an online use must; line pressures solved inside the right-hand side."""
    from scipy.integrate import solve_ivp

    from hilrunner.plant.stability import state_rates

    start = initial_state(plant, _START_M)
    load, rates = plant.load.record(), np.zeros((1, 10))

    def rhs(_t: float, y: np.ndarray, valve: float) -> np.ndarray:
        state_rates(plant.parameters, load, 1.0, plant.circuit, plant.fast, valve, y.reshape(1, 10), rates)
        return rates[0].copy()

    def run() -> np.ndarray:
        y, rows = start.copy(), []
        for valve in held:
            span = (0.0, PERIOD_S)
            y = solve_ivp(rhs, span, y, "Radau", args=(float(valve),), rtol=rtol, atol=rtol * _TYPICAL).y[:, -1]
            rows.append(y)
        return np.array(rows)

    return run


def errors(states: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Largest pressure error, MPa, and position error, mm, over the periods both have."""
    difference = np.abs(states - truth[: len(states)])
    pressure = difference[:, [CHAMBER_1_PRESSURE, CHAMBER_2_PRESSURE]].max() / PA_PER_MPA
    return float(pressure), float(difference[:, ROD_POSITION].max() / M_PER_MM)


def reference_plant(plant: AxisPlant, fast: bool = False, substeps: int = 0) -> AxisPlant:
    """The first-principle plant beside a surrogate's; 0 substeps: chosen from the stability limit."""
    return replace(plant, engine=status.ENGINE_REFERENCE, networks=None, fast=fast, substep_count=substeps)


def equal_accuracy(plant: AxisPlant, held: np.ndarray, truth: np.ndarray, error_mpa: float) -> Case | None:
    """The cheapest compiled reference whose pressure error is not above `error_mpa`; None if there is none."""
    best: tuple[float, Case] | None = None
    variants = (False,) if plant.circuit == status.CIRCUIT_LIFT_LINES else (True, False)
    for fast in variants:
        fewest = default_substep_count(reference_plant(plant, fast), PERIOD_S)
        for substeps in (fewest, 2 * fewest, 4 * fewest):
            case = _reference_case(plant, held, fast, substeps)
            states = case.run()
            if errors(states, truth)[0] > error_mpa:
                continue
            start_s = time.perf_counter()
            case.run()
            cost_s = time.perf_counter() - start_s
            if best is None or cost_s < best[0]:
                best = cost_s, replace(case, name=f"reference of equal accuracy: {case.name}")
            break
    return best[1] if best else None


def _reference_case(plant: AxisPlant, held: np.ndarray, fast: bool, substeps: int = 0) -> Case:
    changed = reference_plant(plant, fast)
    substeps = substeps or default_substep_count(changed, PERIOD_S)
    name = f"{MASS_FREE if fast else EXACT}, RK4 x{substeps}"
    return Case(name, Advance(replace(changed, substep_count=substeps), held))


def _rosenbrock_case(plant: AxisPlant, held: np.ndarray, truth: np.ndarray, error_mpa: float) -> Case:
    """The fewest Rosenbrock steps a period whose pressure error is not above `error_mpa`, else the most that are tried."""
    start = initial_state(plant, _START_M)
    for count in _ROSENBROCK_COUNTS:
        run = Rosenbrock(plant, held, start, count)
        if errors(run(), truth)[0] <= error_mpa:
            break
    return Case(f"{EXACT}, Rosenbrock x{count}, order 4", run)


def cases_of(plant: AxisPlant, onnx_plant: AxisPlant | None, held: np.ndarray, truth: np.ndarray) -> list[Case]:
    """Every engine for one axis, the surrogate first where the profile has one."""
    cases = []
    if plant.engine == status.ENGINE_SURROGATE:
        count = plant.substep_count or default_substep_count(plant, PERIOD_S)
        surrogate = Case(f"{SURROGATE}, RK4 x{count}", Advance(plant, held))
        cases.append(surrogate)
        if onnx_plant is not None:
            cases.append(Case(f"onnxruntime in the loop, RK4 x{count}", Advance(onnx_plant, held)))
        if equal := equal_accuracy(plant, held, truth, errors(surrogate.run(), truth)[0]):
            cases.append(equal)
    reference = reference_plant(plant)
    exact = _reference_case(plant, held, fast=False)
    cases.append(exact)
    cases.append(_reference_case(plant, held, fast=False, substeps=truth_substep_count(reference, PERIOD_S)))
    if plant.circuit != status.CIRCUIT_LIFT_LINES:
        cases.append(_reference_case(plant, held, fast=True))
    cases.append(_rosenbrock_case(reference, held, truth, errors(exact.run(), truth)[0]))
    cases += [Case(f"IDA, rtol {rtol:g}", _ida(reference, held, rtol)) for rtol in (1e-6, 1e-9)]
    cases.append(Case("scipy Radau, rtol 1e-6", _radau(reference, held[:RADAU_PERIODS], 1e-6), RADAU_PERIODS))
    return cases


def cost_table(name: str, plant: AxisPlant, onnx_plant: AxisPlant | None, rounds: int, slice_s: float) -> Table:
    """Cost of 1 ms and error of every engine on one circuit, in turns."""
    held = commands(plant.circuit)
    fine = default_substep_count(reference_plant(plant), PERIOD_S) * _TRUTH_FACTOR
    truth = Advance(reference_plant(plant, substeps=fine), held)().copy()
    if not np.isfinite(truth).all():
        raise ArithmeticError(f"{name}: the reference left the finite numbers")
    cases = cases_of(plant, onnx_plant, held, truth)
    found = {case.name: case.run().copy() for case in cases}
    times = time_turns({case.name: _repeat(case.run) for case in cases}, rounds, slice_s)
    rows, values = [], {}
    for case in cases:
        ns = [one / case.periods for one in times[case.name]]
        first = [one / cases[0].periods for one in times[cases[0].name]]
        pressure_mpa, position_mm = errors(found[case.name], truth)
        ratio = median_ratio(ns, first)
        cost_us = float(np.median(ns)) / 1000
        rows.append(
            (case.name, cost_us, min(ns) / 1000, ratio, pressure_mpa, position_mm, fingerprint(found[case.name][-1]))
        )
        values[case.name] = {"period_ns": ns, "pressure_error_mpa": pressure_mpa, "position_error_mm": position_mm}
    notes = []
    if plant.engine == status.ENGINE_SURROGATE:
        ratio = cases[0].run.served_ratio()
        notes.append(
            f"{ratio:.0%} of the surrogate's evaluations were answered by its networks, the rest solved exactly"
        )
    notes += _allowed_notes(name, rows)
    columns = ("", "median us", "best us", "times first", "p error MPa", "x error mm", "result")
    rows += _paper_rows(cases, times)
    title = f"{name}: 1 ms of the plant, one axis, {PERIODS} periods a run, {rounds} rounds in turns"
    return Table(f"plant_{name}", title, columns, rows, notes, {"cases": values})


def _allowed_notes(name: str, rows: list[tuple]) -> list[str]:
    """Cost and error of the first exact and the first mass-free reference beside what they may be."""
    notes = []
    for kind in (EXACT, MASS_FREE):
        row = next((row for row in rows if row[0].startswith(f"{kind}, RK4")), None)
        if row is None or (name, kind) not in ALLOWED:
            continue
        allowed_us, allowed_mpa = ALLOWED[name, kind]
        notes.append(
            f"{row[0]}: {row[1]:.1f} us median, {row[2]:.1f} best of {allowed_us:g} us allowed (aim {allowed_us / 2:g}); "
            f"error {row[4]:.1e} of {allowed_mpa:.0e} MPa allowed"
        )
    return notes


def _repeat(run: Callable[[], object]) -> Callable[[int], None]:
    def repeated(count: int) -> None:
        for _ in range(count):
            run()

    return repeated


def _paper_rows(cases: list[Case], times: dict[str, list[float]]) -> list[tuple]:
    first_ns = float(np.median(times[cases[0].name])) / cases[0].periods
    return [
        (f"article, {name} (printed, another machine)", ns / 1000, None, ns / first_ns, None, None, "")
        for name, ns in (("surrogate", PAPER_SURROGATE_NS), ("first-principle model", PAPER_REFERENCE_NS))
    ]


def rk4_step_table(plants: dict[str, AxisPlant], rounds: int, slice_s: float) -> Table:
    """One RK4 step (four evaluations) of every surrogate, in turns: a period of one substep, whatever the stability."""
    runs = {}
    for name, plant in plants.items():
        # a substep as short as in the profile, so that the state stays in range
        count = plant.substep_count or default_substep_count(plant, PERIOD_S)
        runs[name] = Advance(replace(plant, substep_count=1), commands(plant.circuit), PERIOD_S / count)
    times = time_turns({name: _repeat(run) for name, run in runs.items()}, rounds, slice_s)
    rows = [
        (name, float(np.median(ns)) / PERIODS, min(ns) / PERIODS, f"{runs[name].served_ratio():.0%}")
        for name, ns in times.items()
    ]
    values = {f"{name}_ns": [one / PERIODS for one in ns] for name, ns in times.items()}
    title = f"One RK4 step of one axis: four evaluations, networks and everything else, {rounds} rounds in turns"
    return Table("rk4_step", title, ("surrogate", "median ns", "best ns", "by network"), rows, [], values)


def lines_plant(lift: AxisPlant) -> AxisPlant:
    """The same axis with line volumes as states (circuit lift-lines), first-principle."""
    return replace(reference_plant(lift), circuit=status.CIRCUIT_LIFT_LINES)
