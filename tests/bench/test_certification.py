"""The certificate of the plant's solvers can say no, and its tool runs: short here, whole in tools/certify_plant."""

import json
import math
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.bench import certification, plant_cases
from hilrunner.plant import step
from hilrunner.setup.axes import make_axis_plants, reference_plants, truth_substep_count
from hilrunner.setup.profile import load_profile
from tests.rules import tree


def quiet(what, share):
    pass


@pytest.fixture
def tool():
    loader = SourceFileLoader("certify_plant", str(tree.ROOT / "tools" / "certify_plant"))
    module = module_from_spec(spec_from_loader("certify_plant", loader))
    loader.exec_module(module)
    return module


def run_tool(tool, monkeypatch, capsys, *words):
    monkeypatch.setattr("sys.argv", ["certify_plant", *words])
    code = tool.main()
    return code, capsys.readouterr().out


SHORT = ("--quick", "--only", "lift: 2 ms ramps")


def test_the_tool_prints_every_part_and_passes(tool, monkeypatch, capsys):
    code, out = run_tool(tool, monkeypatch, capsys, "--json", *SHORT)
    found = json.loads(out)
    assert code == 0 and found["met"] is True
    assert {row["part"] for row in found["rows"]} == {"order", "20 s lift, 2 ms ramps", "hold"}
    judge = next(row for row in found["rows"] if row["compared"].startswith("reference that judges"))
    assert 0.0 < judge["p1_mpa"] < judge["limits"]["p1_mpa"] == 1e-6
    assert 0.0 < judge["x_mm"] < judge["limits"]["x_mm"] == 1e-6


def test_the_tool_fails_and_says_where(tool, monkeypatch, capsys):
    monkeypatch.setattr(certification, "truth_substep_count", lambda plant, period: 9)
    code, out = run_tool(tool, monkeypatch, capsys, *SHORT)
    assert code == 1
    failed = [line for line in out.splitlines() if "NOT MET" in line]
    assert len(failed) == 1 and "reference that judges, RK4 x9" in failed[0]


def test_a_wrong_order_is_not_met(monkeypatch):
    honest = certification.plant_cases.run

    def biased(plant, *arguments, **options):
        states, flags = honest(plant, *arguments, **options)
        return states + 10.0 / max(plant.substep_count, 1), flags  # an error of first order, 0.3 to 0.6 Pa

    monkeypatch.setattr(certification.plant_cases, "run", biased)
    assert [row.met for row in certification.order_rows(quiet)] == [False] * 5


@pytest.mark.parametrize(
    ("value", "met"), [(0.5, True), (1.5, False), (math.nan, False), (math.inf, False), (-1, False)]
)
def test_a_figure_is_met_within_its_limits_only(value, met):
    figure = certification.Figure("p1", value, "MPa", 1.0, 0.0)
    assert figure.met is met
    assert certification.Row("part", "case", "compared", (figure,)).met is met


def test_what_is_told_is_not_judged():
    assert certification.Row("p", "c", "x", (certification.Figure("x", 1.0, "mm"),)).met is None


def test_a_leaking_valve_is_found():
    """A counterbalance valve set below what the load asks of it lets the load sink."""
    tight = plant_cases.plant(status.CIRCUIT_LIFT)
    drift_mm, oil_ratio, bounce_mm = certification.hold(tight, 120.0, lambda share: None)
    assert drift_mm < 1e-6 and oil_ratio < 1e-12 and bounce_mm > 0.01
    leaking = plant_cases.plant(status.CIRCUIT_LIFT, overrides={"setting_1_mpa": 8.9})
    drift_mm, oil_ratio, _ = certification.hold(leaking, 120.0, lambda share: None, step.initial_state(tight, 0.6))
    assert drift_mm > certification.DRIFT_MM and oil_ratio > certification.OIL_RATIO


def test_every_list_of_the_certificate_has_its_runs():
    groups = {case.group: {c.circuit for c in plant_cases.CASES if c.group == case.group} for case in plant_cases.CASES}
    every = {status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES}
    assert groups[plant_cases.LIFT_20S] == groups[plant_cases.LIFT_2MS] == groups[plant_cases.OVERRUN] == every
    assert {status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES} <= groups[plant_cases.CYCLE_60S]
    cycle = plant_cases.case_named("lift: lift-hold-lower-hold").commands()
    assert len(cycle) == 60_000 and cycle.max() == 1.0 and cycle.min() == -1.0 and np.any(cycle == 0.0)


def test_a_reference_that_judges_takes_finer_steps_than_the_loop():
    loaded = load_profile("amc-lift")
    loop = make_axis_plants(loaded, status.ENGINE_REFERENCE)[0]
    judge = reference_plants(loaded)[0]
    assert judge.substep_count == 20 > loop.substep_count
    assert truth_substep_count(loop, 1e-4) == loop.substep_count  # a period it already divides finer
    assert truth_substep_count(plant_cases.plant(), 2e-3) == 40
