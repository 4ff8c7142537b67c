"""One case through the surrogate and through the truth, and how far they are apart."""

import time
from dataclasses import dataclass, replace

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import StateError
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.plant.ida import solve_ida
from hilrunner.plant.step import SCRATCH_SIZE, AxisPlant, advance_many, assemble
from hilrunner.plant.surrogate import EXACT_AT, SERVED_AT
from hilrunner.reproduce.cases import Case
from hilrunner.reproduce.models import PERIOD_S

# symbol -> (place in base.state_layout, factor to the unit shown, unit)
QUANTITIES = {
    "p1": (2, PA_PER_MPA, "MPa"),
    "p2": (3, PA_PER_MPA, "MPa"),
    "x": (0, M_PER_MM, "mm"),
    "v": (1, M_PER_MM, "mm/s"),
}
REFERENCE_SUBSTEPS = 20  # within 2e-7 MPa and 3e-7 mm of IDA at rtol 1e-11 (tests/cross/plant)


@dataclass(frozen=True)
class Error:
    """Errors of one quantity over a run, in `unit`; normalised by the range the quantity covers in the truth."""

    unit: str
    max: float
    rms: float
    max_normalised: float
    rms_normalised: float


@dataclass(frozen=True, eq=False)
class Ran:
    """One engine over one case."""

    states: np.ndarray  # float64[n, 10]
    flags: int  # OR of status.FLAG_*
    served_ratio: float  # share of the evaluations that networks answered; NaN for the reference


@dataclass(frozen=True, eq=False)
class Comparison:
    """A surrogate beside the truth over one case."""

    case: Case
    surrogate: AxisPlant
    ran: Ran
    truth: np.ndarray  # float64[n, 10]
    truth_words: str
    errors: dict[str, Error]  # by symbol of QUANTITIES
    truth_wall_s: float

    @property
    def label(self) -> str:
        """What was compared with what."""
        return f"{surrogate_words(self.surrogate)}; truth: {self.truth_words}"


def run_engine(plant: AxisPlant, case: Case) -> Ran:
    """A case through one compiled engine."""
    count = len(case.commands)
    states = np.full((count, 10), np.nan)  # what a diverged run leaves out stays so
    flags, scratch = np.zeros(count, np.int64), np.zeros(SCRATCH_SIZE)
    model = assemble([plant], PERIOD_S)
    seen = advance_many(model, 0, case.commands, case.load_scales, PERIOD_S, case.start.copy(), scratch, states, flags)
    served, exact = scratch[SERVED_AT], scratch[EXACT_AT]
    ratio = float(served / (served + exact)) if served + exact else float("nan")
    return Ran(states, int(seen), ratio)


def errors_of(states: np.ndarray, truth: np.ndarray) -> dict[str, Error]:
    """Errors by symbol; a state that is not finite makes its figures NaN."""
    found = {}
    for symbol, (place, factor, unit) in QUANTITIES.items():
        error = (states[:, place] - truth[:, place]) / factor
        spread = float(np.ptp(truth[:, place])) / factor
        largest, rms = float(np.abs(error).max()), float(np.sqrt(np.mean(error**2)))
        per = 1.0 / spread if spread > 0 else float("nan")
        found[symbol] = Error(unit, largest, rms, largest * per, rms * per)
    return found


def truth_of(case: Case, rtol: float | None) -> tuple[np.ndarray, str, float]:
    """(states, what it is, seconds) of the full DAE by IDA; rtol None: the compiled reference instead.

    Where IDA gives up the compiled reference stands in, and the words say so.
    """
    begin_s = time.perf_counter()
    words = ""
    if rtol is not None:
        try:
            states = solve_ida(case.plant, case.commands, case.load_scales, PERIOD_S, case.start, rtol=rtol)
            return states, f"full DAE by IDA, compiled residual, rtol {rtol:g}", time.perf_counter() - begin_s
        except StateError as error:
            words = f" ({error.place}: {error.problem})"
    fine = replace(case.plant, substep_count=REFERENCE_SUBSTEPS)
    states = run_engine(fine, case).states
    words = f"compiled first-principle model, RK4 x{REFERENCE_SUBSTEPS} per 1 ms{words}"
    return states, words, time.perf_counter() - begin_s


def compare(case: Case, surrogate: AxisPlant, rtol: float | None) -> Comparison:
    """Surrogate and truth over one case."""
    truth, words, wall_s = truth_of(case, rtol)
    return against(case, surrogate, truth, words, wall_s)


def against(case: Case, surrogate: AxisPlant, truth: np.ndarray, words: str, wall_s: float = 0.0) -> Comparison:
    """The same with a truth already at hand."""
    mine = replace(surrogate, load=case.plant.load)
    ran = run_engine(mine, case)
    return Comparison(case, mine, ran, truth, words, errors_of(ran.states, truth), wall_s)


def surrogate_words(plant: AxisPlant) -> str:
    """A surrogate, or its reduced model without networks, in words."""
    if plant.networks is None:
        return f"reduced model solved exactly, compiled, RK4 x{plant.substep_count} per 1 ms"
    source = plant.networks.source.partition(" ")[0] or "networks"
    return f"surrogate {source}, compiled, RK4 x{plant.substep_count} per 1 ms"


def outside_training(ran: Ran) -> bool:
    """Whether a network was asked outside its training range."""
    return bool(ran.flags & status.FLAG_OUTSIDE_TRAINING)
