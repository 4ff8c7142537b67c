"""Requirements of a profile are part of the one verdict: report, JUnit and exit code show them beside the limits."""

import pytest
from synthetic_run import PROFILE, write_run

from hilrunner.base.errors import ProfileError
from hilrunner.evidence.junit import junit_xml
from hilrunner.evidence.report import build_report
from hilrunner.setup.profile import parse_profile

KEPT = "always chamber_1_pressure < 12 MPa"
BROKEN = "always (valve_command > 50 % implies lift.rod_velocity < 10 mm/s)"


def profile_with(*formulas: str) -> str:
    """The synthetic run's profile without limits, with these requirements."""
    text = PROFILE.split("[limits]")[0]
    for index, formula in enumerate(formulas):
        text += f'[[requirement]]\nid = "R{index}"\ntext = "the {index}. thing asked for"\nformula = "{formula}"\n'
    return text


def judged(tmp_path, *formulas):
    """The report of a synthetic run of 20 s."""
    path = write_run(tmp_path / "run.mcap", 20_000, profile_text=profile_with(*formulas))
    return build_report(path)


def test_a_requirement_that_holds_is_a_verdict(tmp_path):
    verdict = judged(tmp_path, KEPT).verdict
    (row,) = [one for one in verdict.judgements if one.key == "requirement R0"]
    assert (row.outcome, row.unit) == ("passed", "MPa")
    assert row.value == pytest.approx(12.0 - 9.26, abs=0.05)
    assert verdict.passed  # a profile with a requirement says what is asked for


def test_a_broken_one_fails_with_its_margin_and_its_moment(tmp_path):
    verdict = judged(tmp_path, KEPT, BROKEN).verdict
    assert (verdict.outcome, verdict.exit_code) == ("failed", 1)
    (row,) = verdict.failed
    assert row.key == "requirement R1" and row.unit == "mm/s"
    assert row.value == pytest.approx(10.0 - 22.5 * 0.8, abs=0.1)
    assert "decided at" in row.detail and "rod_velocity < 10 mm/s" in row.detail


def test_junit_has_a_case_for_each(tmp_path):
    report = judged(tmp_path, KEPT, BROKEN)
    text = junit_xml(report.verdict, "suite", 20.0, {})
    assert text.count('name="requirement R') == 2 and "the 1. thing asked for" in text


def test_what_the_log_does_not_reach_is_not_judged(tmp_path):
    verdict = judged(tmp_path, "always[30 s, 40 s] chamber_1_pressure < 12 MPa").verdict
    (row,) = verdict.failed
    assert row.outcome == "not judged" and "too short" in row.detail


@pytest.mark.parametrize(
    ("formula", "words"),
    [("always pressure < 12 MPa", "no signal 'pressure'"), ("always lift.end_stop <", "expected a value")],
)
def test_a_formula_that_does_not_fit_is_refused_when_the_profile_is_loaded(formula, words):
    with pytest.raises(ProfileError, match=words):
        parse_profile(profile_with(formula), "bench.toml")
