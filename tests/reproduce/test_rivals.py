"""The rivals of the timing solve the same model; the processes of their own answer; the article's pipeline runs anew."""

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.bench import plant_step
from hilrunner.bench.cold_newton import cold_newton_states
from hilrunner.bench.library_ida import library_ida_states
from hilrunner.plant.step import assemble, initial_state
from hilrunner.reproduce import interpreted, memory, retrain, timing
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PERIOD_S, Models, reference_of
from hilrunner.training.train import Plan, Stage


def test_cold_newton_and_the_packages_ida_solve_the_same_model():
    """Where the first guess comes from may cost time and nothing else."""
    reference = reference_of("paper")
    held = plant_step.commands(reference.circuit)[:60]
    start = initial_state(reference, 0.6)
    exact = plant_step.Advance(reference, held)()
    cold = cold_newton_states(assemble([reference], PERIOD_S), held, PERIOD_S, start)
    assert np.ptp(exact[:, 0]) > 1e-6
    np.testing.assert_allclose(cold[:, :4], exact[:, :4], rtol=1e-7, atol=1e-9)
    library = library_ida_states(reference, held, PERIOD_S, start, 1e-6)
    assert plant_step.errors(library, exact)[0] < 1e-3


def test_ida_is_made_to_start_anew_each_period():
    factors = timing._every_millisecond(6)
    assert np.all(np.diff(factors) != 0.0) and np.abs(factors - 1.0).max() < 1e-15


@pytest.mark.parametrize(("profile", "file"), [("paper", PAPER_FLOW), ("amc-lift", LIFT_FLOW)])
def test_interpreted_engines_answer_in_a_process_of_their_own(profile, file, monkeypatch):
    """Cold Newton of circuit lift is checked here too: uncompiled, so that no test waits for its compiler."""
    monkeypatch.setattr(timing, "_INTERPRETED_PERIODS", 5)
    models, reference = Models.of(None), reference_of(profile)
    surrogate = models.surrogate(file, reference)
    circuit = status.CIRCUIT_NAMES[reference.circuit]
    found = timing.interpreted(circuit, models.path(file), reference, surrogate)
    assert min(found[f"{engine}_s"] for engine in ("surrogate", "reference", "cold_newton")) > 1e-5
    assert found["cold_newton_difference"] < 1e-7


def test_the_interpreted_process_refuses_to_run_compiled():
    with pytest.raises(SystemExit, match="NUMBA_DISABLE_JIT"):
        interpreted.measure({"circuit": "paper"})


def test_a_process_that_fails_is_told_with_its_last_words():
    with pytest.raises(RuntimeError, match="hilrunner.reproduce.memory ended with 1.*KeyError"):
        timing.ask_process("hilrunner.reproduce.memory", {})


def test_memory_counts_what_the_engine_reads():
    path = str(Models.of(None).path(LIFT_FLOW))
    surrogate = memory.measure({"engine": "surrogate", "model": path})
    reference = memory.measure({"engine": "reference", "model": path})
    # 1177 numbers of 8 bytes, and the padding of vectors, come on top of the plant
    assert 9416 < surrogate["state_bytes"] - reference["state_bytes"] < 20_000
    assert surrogate["resident_bytes"] > 20e6


def test_the_articles_pipeline_runs_anew(tmp_path, monkeypatch):
    plan = Plan(300, 100, 200, (Stage(300, 8),))
    monkeypatch.setitem(retrain._PLANS, "small", plan)
    monkeypatch.setitem(retrain._RIVAL_S_MAX, "small", 0.2)
    part = retrain.training_part(tmp_path, "small")
    rows = {row.key: row for row in part.rows}
    assert rows["training.iterations"].measured == 8 and 0.0 < rows["training.normalised"].measured < 1.0
    assert rows["training.cpu"].measured > 0.0
    assert (tmp_path / "small" / "paper-rates.onnx").is_file()
    assert [row[0].partition(" ")[0] for row in part.details[-1].rows] == ["Levenberg-Marquardt,", "Adam", "L-BFGS"]
