"""What 1 ms of the plant costs: surrogate, first-principle models as tools solve them, and our own best exact model.

All compiled engines take turns in one thread of one process; a figure is the median of the ratios within a round. The
interpreted engines run in a process of their own without compilation, as the article's models presumably did.
"""

import json
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilrunner.bench import plant_step
from hilrunner.bench.cold_newton import cold_newton_states
from hilrunner.bench.library_ida import library_ida_states
from hilrunner.bench.turns import median_ratio, time_turns
from hilrunner.plant.ida import solve_ida
from hilrunner.plant.step import AxisPlant, assemble, default_substep_count, initial_state
from hilrunner.record import child
from hilrunner.reproduce import article
from hilrunner.reproduce.compare import surrogate_words
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PERIOD_S, Models, reference_of
from hilrunner.reproduce.rows import Detail, Part, Row

CIRCUITS = (("lift", "amc-lift", LIFT_FLOW), ("paper", "paper", PAPER_FLOW))
AIM_RATIO = 200.0
_START_M = 0.6
_RTOLS = (1e-6, 1e-9)
_LIBRARY_PERIODS = 300  # of all: it is slow
_INTERPRETED_PERIODS = 40
_MOVING_COMMAND = 0.6


@dataclass(frozen=True)
class Rival:
    """One engine: key, words, and a call that runs all periods and gives their states."""

    key: str
    words: str
    run: Callable[[], np.ndarray]
    periods: int


def _every_millisecond(count: int) -> np.ndarray:
    """Load factors of 1 that differ in their last bit from period to period: IDA starts anew in each."""
    factors = np.ones(count)
    factors[1::2] = np.nextafter(1.0, 2.0)
    return factors


def rivals_of(reference: AxisPlant, surrogate: AxisPlant, held: np.ndarray) -> tuple[list[Rival], np.ndarray]:
    """The surrogate first, then everything it is compared with; and the truth, float64[n, 10]."""
    start = initial_state(reference, _START_M)
    fine = replace(reference, substep_count=8 * default_substep_count(reference, PERIOD_S))
    truth = plant_step.Advance(fine, held)().copy()
    own = plant_step.Advance(surrogate, held)
    error_mpa = plant_step.errors(own(), truth)[0]
    rivals = [Rival("surrogate", surrogate_words(surrogate), own, len(held))]
    scales = _every_millisecond(len(held))
    for rtol in _RTOLS:
        words = (
            f"full DAE by IDA re-initialised each 1 ms, residual and the loop around IDA compiled (ours), rtol {rtol:g}"
        )

        def by_ida(rtol: float = rtol) -> np.ndarray:
            return solve_ida(reference, held, scales, PERIOD_S, start, rtol=rtol)

        rivals.append(Rival(f"ida_{rtol:g}", words, by_ida, len(held)))
    few = held[:_LIBRARY_PERIODS]
    words = (
        "full DAE by IDA re-initialised each 1 ms through scikit-sundae's own interface, residual compiled, "
        f"rtol {_RTOLS[0]:g}; {len(few)} of the {len(held)} periods"
    )
    library = Rival(
        "ida_library", words, lambda: library_ida_states(reference, few, PERIOD_S, start, _RTOLS[0]), len(few)
    )
    rivals.append(library)
    model = assemble([reference], PERIOD_S)
    words = f"first-principle model, compiled, RK4 x{reference.substep_count}, cold Newton in every stage"
    rivals.append(Rival("cold_newton", words, lambda: cold_newton_states(model, held, PERIOD_S, start), len(held)))
    words = f"first-principle model, compiled, RK4 x{reference.substep_count} (ours, warm)"
    rivals.append(Rival("reference", words, plant_step.Advance(reference, held), len(held)))
    if equal := plant_step.equal_accuracy(surrogate, held, truth, error_mpa):
        rivals.append(
            Rival("equal", f"our best exact model of equal accuracy, compiled: {equal.name}", equal.run, len(held))
        )
    return rivals, truth


def time_part(models: Models, quick: bool) -> Part:
    """Cost of 1 ms of both circuits, by engine (Table 6)."""
    part = Part("time", "Time for 1 ms of the plant, one thread, in turns (Table 6)")
    rounds, slice_s = (3, 0.05) if quick else (7, 0.3)
    for circuit, profile, file in CIRCUITS:
        reference = reference_of(profile)
        surrogate = models.surrogate(file, reference)
        held = plant_step.commands(reference.circuit)
        _compiled_rows(part, circuit, reference, surrogate, held, rounds, slice_s)
        _interpreted_rows(part, circuit, models.path(file), reference, surrogate)
    _article_rows(part)
    part.notes.append(
        "ratio: how many times the surrogate's time the other takes; above 1 the surrogate is faster. "
        "The article's figures are of uncompiled models on another machine."
    )
    part.notes.append(
        "IDA driven by compiled code (our own yardstick) is some twenty times as fast as through its Python package, which is what a "
        "simulation with standard tools gets; both are told, and both are held against the same must."
    )
    part.notes.append(
        "For Eq. (9) the algebraic pressure has a closed form, and for lift a warm-started Newton solve takes about one "
        "evaluation: against our own best exact model a network saves nothing. It pays against solvers that start anew each step, "
        "and where no equations exist."
    )
    return part


def _compiled_rows(part: Part, circuit: str, reference, surrogate, held, rounds: int, slice_s: float) -> None:
    rivals, truth = rivals_of(reference, surrogate, held)
    errors = {rival.key: plant_step.errors(rival.run(), truth) for rival in rivals}
    slices = time_turns({rival.key: _repeated(rival.run) for rival in rivals}, rounds, slice_s)
    times = {rival.key: [one / rival.periods for one in slices[rival.key]] for rival in rivals}
    table = []
    for rival in rivals:
        ratio = median_ratio(times[rival.key], times["surrogate"])
        cost_us = float(np.median(times[rival.key])) / 1e3
        table.append((rival.words, cost_us, ratio, *errors[rival.key]))
    part.rows += _ratio_rows(circuit, rivals, times, table[0][1])
    head = ("engine", "us for 1 ms", "times the surrogate's", "p error MPa", "x error mm")
    title = f"Circuit {circuit}, compiled: {len(held)} periods a run, {rounds} rounds in turns, medians"
    part.details.append(Detail(title, head, table))


def _ratio_rows(circuit: str, rivals: list[Rival], times: dict, cost_us: float) -> list[Row]:
    own = Row(
        f"time.{circuit}.surrogate", f"circuit {circuit}: 1 ms by the surrogate", cost_us / 1e3, "ms", rivals[0].words,
        article.SURROGATE_STEP_MS, "Table 6, uncompiled", timing=True,
    )  # fmt: skip
    rows = [own]
    tools = dict.fromkeys(("ida_1e-06", "ida_1e-09", "ida_library"), (article.SPEED_RATIO, AIM_RATIO))
    limits = tools | {"equal": (None, 1.0)}
    for rival in rivals[1:]:
        must, aim = limits.get(rival.key, (None, None)) if circuit == "lift" else (None, None)
        ratio = median_ratio(times[rival.key], times["surrogate"])
        what = f"circuit {circuit}: time over the surrogate's, {_SHORT[rival.key]}"
        paper = None if rival.key in ("equal", "reference") else article.SPEED_RATIO
        source = "Table 6, uncompiled" if paper else "not reported"
        rows.append(
            Row(f"time.{circuit}.{rival.key}", what, ratio, "x", rival.words, paper, source, must, aim, True, True)
        )
    return rows


_SHORT = {
    "ida_1e-06": "IDA re-initialised each step, rtol 1e-6",
    "ida_1e-09": "IDA re-initialised each step, rtol 1e-9",
    "ida_library": "IDA as its Python package offers it, re-initialised each step, rtol 1e-6",
    "cold_newton": "cold Newton in every stage",
    "reference": "our compiled reference",
    "equal": "our best exact model of equal accuracy",
}


def _repeated(run: Callable[[], object]) -> Callable[[int], None]:
    def repeated(count: int) -> None:
        for _ in range(count):
            run()

    return repeated


def _article_rows(part: Part) -> None:
    rows = [
        ("first-principle model", article.FIRST_PRINCIPLE_STEP_MS),
        ("surrogate", article.SURROGATE_STEP_MS),
        ("ratio", article.SPEED_RATIO),
    ]
    title = "The article's Table 6: one step, ms, uncompiled, AMD 4800H, step size not stated"
    part.details.append(Detail(title, ("model", "ms"), rows))


# -- interpreted ------------------------------------------------------------------------------------------------------


def _interpreted_rows(part: Part, circuit: str, path, reference: AxisPlant, surrogate: AxisPlant) -> None:
    found = interpreted(circuit, path, reference, surrogate)
    ratio = found["reference_s"] / found["surrogate_s"]
    warm = "closed form of Eq. (5)" if circuit == "paper" else "warm Newton"
    counts = f"RK4 x{reference.substep_count} against x{surrogate.substep_count}"
    label = f"both interpreted (NUMBA_DISABLE_JIT=1), first principle in Python, network in numpy; {counts}"
    for key, words, paper in (
        ("surrogate", "surrogate", article.SURROGATE_STEP_MS),
        ("reference", f"first-principle model, {warm}", article.FIRST_PRINCIPLE_STEP_MS),
        ("cold_newton", "first-principle model, cold Newton in every stage", article.FIRST_PRINCIPLE_STEP_MS),
    ):
        what = f"circuit {circuit}, interpreted: 1 ms by the {words}"
        cost_ms = found[f"{key}_s"] * 1e3
        part.rows.append(
            Row(f"time.{circuit}.interpreted.{key}", what, cost_ms, "ms", label, paper, "Table 6", timing=True)
        )
    for key, words, value in (
        ("ratio", warm, ratio),
        ("cold_ratio", "cold Newton", found["cold_newton_s"] / found["surrogate_s"]),
    ):
        what = f"circuit {circuit}, interpreted: first-principle model ({words}) over surrogate"
        row = Row(
            f"time.{circuit}.interpreted.{key}", what, value, "x", label, article.SPEED_RATIO, "Table 6",
            at_least=True, timing=True,
        )  # fmt: skip
        part.rows.append(row)


def interpreted(circuit: str, path, reference: AxisPlant, surrogate: AxisPlant) -> dict[str, float]:
    """Seconds for 1 ms of each engine in a process without compilation (reproduce.interpreted)."""
    request = {
        "circuit": circuit,
        "model": str(path),
        "start": initial_state(reference, _START_M, _MOVING_COMMAND).tolist(),
        "command": _MOVING_COMMAND,
        "reference_substeps": int(reference.substep_count),
        "surrogate_substeps": int(surrogate.substep_count),
        "periods": _INTERPRETED_PERIODS,
    }
    return ask_process("hilrunner.reproduce.interpreted", request, {"NUMBA_DISABLE_JIT": "1"})


def ask_process(module: str, request: dict, environment: dict[str, str] | None = None) -> dict:
    """Run a module of this package as a process: JSON in, JSON out; RuntimeError with its last words where it fails."""
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    done = subprocess.run(
        child.module_command(module),
        input=json.dumps(request),
        env=child.environment(**threads, **(environment or {})),
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        last_words = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise RuntimeError(f"{module} ended with {done.returncode}: {last_words}")
    return json.loads(done.stdout)
