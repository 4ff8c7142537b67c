"""Formulas as a person writes them: units, words, errors with their position, and the moment that decides."""

import numpy as np
import pytest

from hilrunner.base.errors import UsageError
from hilrunner.requirements.dimension import UNITS
from hilrunner.requirements.parse import SignalKind, parse_formula
from hilrunner.requirements.requirement import Written, read_requirements, understand
from hilrunner.requirements.verdict import judge_requirement

LENGTH, PRESSURE = UNITS["m"].dimension, UNITS["Pa"].dimension
KINDS = {
    "position": SignalKind(LENGTH),
    "pressure": SignalKind(PRESSURE),
    "command": SignalKind(UNITS["1"].dimension),
    "mode": SignalKind(UNITS["1"].dimension, words=("waiting", "active", "fail-safe")),
    "end_stop": SignalKind(UNITS["1"].dimension, truth=True),
}
COUNT, PERIOD_S = 101, 0.01
TIME_S = np.arange(COUNT) * PERIOD_S
RUN = {
    "position": 0.6 + 0.01 * TIME_S,
    "pressure": 9e6 + 1e6 * np.sin(2 * np.pi * TIME_S),
    "command": np.where(TIME_S < 0.5, 0.3, 0.0),
    "mode": np.where(TIME_S < 0.3, 1.0, 2.0),
    "end_stop": np.zeros(COUNT),
}


def judged(formula: str):
    """One formula over the run above."""
    (requirement,) = understand((Written("R1", formula),), KINDS, "test")
    return judge_requirement(requirement, RUN, PERIOD_S)


@pytest.mark.parametrize(
    ("formula", "outcome", "margin", "unit", "time_s"),
    [
        ("always pressure < 10.5 MPa", "passed", 0.5, "MPa", 0.25),
        ("always pressure < 95 bar", "failed", -0.5, "MPa", 0.25),
        ("always[0.5 s, 1 s] pressure < 95 bar", "passed", 0.5, "MPa", 0.5),
        ("eventually position > 605 mm", "passed", 5.0, "mm", 1.0),
        ("always abs(position - 600 mm) < 4 mm", "failed", -6.0, "mm", 1.0),
        ("always rate(position) < 20 mm/s", "passed", 10.0, "mm/s", 0.01),
        ("always (mode == fail-safe implies eventually[0 s, 200 ms] abs(command) <= 1 %)", "passed", 0.01, "", 0.5),
        ("always (mode == fail-safe implies eventually[0 s, 100 ms] abs(command) <= 1 %)", "failed", -0.29, "", 0.4),
        ("always not end_stop", "passed", 1.0, "", 0.0),
        ("always (mode != fail-safe or command < 50 %)", "passed", 0.2, "", 0.3),
        ("pressure < 10 MPa until[0 s, 300 ms] mode == fail-safe", "passed", 0.0, "MPa", 0.25),
        ("always max(pressure, 5 MPa) - min(pressure, 20 MPa) <= 0 MPa", "passed", 0.0, "MPa", 0.0),
    ],
)
def test_a_margin_is_in_the_unit_of_what_decides(formula, outcome, margin, unit, time_s):
    found = judged(formula)
    assert found.outcome == outcome, found
    assert found.margin == pytest.approx(margin, abs=1e-6)
    assert found.unit == unit


def test_the_moment_that_decides_is_told():
    found = judged("always (command > 10 % implies pressure < 95 bar)")
    assert (found.outcome, found.decided_by) == ("failed", "command > 10 %")
    assert judged("always pressure < 95 bar").time_s == pytest.approx(0.25)
    assert judged("eventually[0.6 s, 0.9 s] position > 605 mm").time_s == pytest.approx(0.9)


def test_a_run_too_short_for_its_interval_is_not_judged():
    found = judged("always[2 s, 3 s] pressure < 1 MPa")
    assert found.outcome == "not judged" and "too short" in found.detail


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("always presure < 10 MPa", "no signal 'presure'.*allowed: pressure"),
        ("always pressure < 10", "cannot be compared"),
        ("always pressure < 10 mm", "cannot be compared"),
        ("always pressure + position < 10 MPa", "cannot be added"),
        ("always pressure", "a value where something true or false is needed"),
        ("always[0, 5] end_stop", "a bound of an interval is a time"),
        ("always[2 s, 1 s] end_stop", "before it begins"),
        ("always mode == stopped", "holds one of several words.*waiting, active, fail-safe"),
        ("always (pressure < 10 MPa", r"expected \)"),
        ("always pressure < 10 MPa $", "no meaning here"),
        ("always abs(pressure, position) < 1 MPa", "abs takes 1 values"),
        ("(" * 200 + "end_stop" + ")" * 200, "nested too deeply"),
        ("and end_stop", "stands in the wrong place"),
    ],
)
def test_an_error_names_place_and_remedy(formula, words):
    with pytest.raises(UsageError, match=words) as refused:
        parse_formula(formula, KINDS, "bench.toml: requirement R1")
    assert "bench.toml: requirement R1, character" in refused.value.place


def test_two_requirements_of_one_id_are_refused():
    with pytest.raises(UsageError, match="given twice"):
        understand((Written("R1", "true"), Written("R1", "false")), KINDS, "test")


def test_a_file_is_read_and_its_errors_name_the_key(tmp_path):
    path = tmp_path / "requirements.toml"
    path.write_text('\ufeff[[requirement]]\nid = "R1"\nformula = "always end_stop"\nsource = "EN 12999, 5.6.3"\n')
    assert read_requirements(path)[0].source == "EN 12999, 5.6.3"
    path.write_bytes('[[requirement]]\nid = "R1"\nformula = "true"\ntext = "fährt"\n'.encode("cp1252"))
    assert read_requirements(path)[0].text == "fährt"
    path.write_text('[[requirement]]\nid = "R1"\nformla = "always end_stop"\n')
    with pytest.raises(UsageError, match="formula"):
        read_requirements(path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_requirements(tmp_path / "missing.toml")
