"""Each limit passes and fails where it should; what cannot be told is not passed."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.evidence import plant_use
from hilrunner.evidence.junit import junit_xml
from hilrunner.evidence.report import build_report
from hilrunner.evidence.verdict import FAILED, NO_LIMITS, NOT_JUDGED, PASSED
from hilrunner.setup.limits import KEYS
from tests.tools import synthetic_run
from tests.tools.copy_log import copy_with

# value of each limit that the synthetic run below just keeps, and one it breaks
EDGES = {
    "deadline_misses_max": (3, 2),
    "deadline_miss_ratio_max": (0.0026, 0.0024),
    "skipped_periods_max": (6, 5),
    "wake_lateness_us_max": (2200.0, 2199.0),
    "wake_lateness_us_p999": (1200.0, 500.0),
    "execution_us_max": (3200.0, 3100.0),
    "response_us_max": (3500.0, 3000.0),
    "command_age_ms_max": (0.0, None),
    "frames_rejected_max": (2, 1),
    "bus_load_ratio_max": (0.55, 0.53),
    "fail_safe_ms_max": (61.0, 60.0),
    "ticks_lost_max": (0, None),
    "frames_lost_max": (0, None),
    "misses_lost_max": (0, None),
    "pressure_mpa_min": (0.5, 0.7),
    "pressure_mpa_max": (10.0, 9.0),
    "rod_position_mm_min": (599.0, 601.0),
    "rod_position_mm_max": (621.0, 619.0),
    "rod_speed_mmps_max": (18.1, 17.9),
    "settling_ms_max": (0.0, None),
    "end_stop_ticks_max": (4, 3),
    "cavitation_ticks_max": (0, None),
    "outside_training_ticks_max": (5, 4),
    "check_failures_max": (7, 6),
    "unchecked_ticks_max": (0, None),
    "check_pressure_mpa_max": (0.01, 0.0001),
    "check_position_mm_max": (0.1, 0.0001),
}
TICKS = 3590  # one stop of the valve, three stalls
NEEDS_REFERENCE = {"tracking_error_mm_max", "tracking_error_mm_rms"}


def eventful(block):
    """Flags, refused frames, a fail-safe and failed checks at known counts."""
    block["can"]["status"][[0, 4]] = status.FRAME_BAD_CRC
    block["state"]["flags"][100:104] = status.FLAG_END_STOP
    block["state"]["flags"][200:205] = status.FLAG_OUTSIDE_TRAINING
    block["check"]["flags"][300:307] = 1
    command = block["command"]
    command["mode"][1400:1450] = status.MODE_FAIL_SAFE
    command["age_ns"][1400:1450] = 60_500_000 + np.arange(50) * 1_000_000


def profile(limits: str) -> str:
    return f'name = "judged"\n[[axis]]\nname = "lift"\n[limits]\n{limits}'


def report_of(tmp_path, limits: str, reference=None, **options):
    options = {"stall_every": 900, "edit": eventful, **options}
    path = synthetic_run.write_run(tmp_path / "run.mcap", TICKS, profile_text=profile(limits), **options)
    return build_report(path, reference)


def test_every_limit_has_an_edge_here():
    assert set(EDGES) | NEEDS_REFERENCE | {"settling_speed_mmps"} == set(KEYS)


def test_all_limits_kept_pass(tmp_path):
    limits = "\n".join(f"{key} = {kept}" for key, (kept, _) in EDGES.items())
    report = report_of(tmp_path, limits)
    failed = [one for one in report.verdict.judgements if one.outcome != PASSED]
    assert failed == []
    assert report.verdict.exit_code == 0
    assert {one.key for one in report.verdict.judgements if not one.by_default} == set(EDGES)
    assert report.verdict.outcome == PASSED and report.verdict.passed


def test_every_limit_broken_fails(tmp_path):
    broken = {key: value for key, (_, value) in EDGES.items() if value is not None}
    report = report_of(tmp_path, "\n".join(f"{key} = {value}" for key, value in broken.items()))
    outcomes = {one.key: one.outcome for one in report.verdict.judgements}
    assert {key for key, outcome in outcomes.items() if outcome == FAILED} == set(broken)
    assert report.verdict.exit_code == 5


def test_without_model_limits_the_exit_code_is_1(tmp_path):
    report = report_of(tmp_path, "rod_speed_mmps_max = 1.0\ncheck_failures_max = 7")
    assert report.verdict.exit_code == 1


def test_a_failed_cross_check_does_not_hide_a_broken_limit(tmp_path):
    """Exit code 5 comes first, and everything else that is wrong is told with it."""
    verdict = report_of(tmp_path, "rod_speed_mmps_max = 1.0").verdict
    assert verdict.exit_code == 5
    assert [text.split(":")[0] for text in verdict.causes] == ["check_failures_max", "rod_speed_mmps_max"]
    assert "18 against 1 mm/s" in verdict.causes[1]


def test_what_cannot_be_told_does_not_pass(tmp_path):
    report = report_of(tmp_path, "tracking_error_mm_max = 10.0\nresponse_us_max = 1e6", edit=_bare)
    outcomes = {one.key: one for one in report.verdict.judgements}
    assert outcomes["tracking_error_mm_max"].outcome == NOT_JUDGED
    assert "no wave" in outcomes["tracking_error_mm_max"].detail
    assert outcomes["response_us_max"].outcome == NOT_JUDGED
    assert "limit 10 mm" in next(text for text in report.verdict.causes if text.startswith("tracking_error_mm_max"))
    assert report.verdict.exit_code == 1


def _bare(block):
    block["can"] = block["can"][:0]


def test_a_limit_of_another_version_is_told_and_does_not_pass(tmp_path):
    report = report_of(tmp_path, "speed_of_light_max = 1.0\nrod_speed_mmps_max = 100.0")
    outcomes = {one.key: one.outcome for one in report.verdict.judgements}
    assert outcomes["speed_of_light_max"] == NOT_JUDGED
    assert outcomes["rod_speed_mmps_max"] == PASSED
    assert any("not one of this version" in note for note in report.facts.notes)


def test_a_run_that_did_not_end_as_planned_fails(tmp_path):
    def ended(reason):
        metadata = {"run": {"exit_reason": reason}}
        path = synthetic_run.write_run(tmp_path / "run.mcap", 500, profile_text=profile(""), metadata=metadata)
        verdict = build_report(path).verdict
        return next(one for one in verdict.judgements if one.key == "ended_as_planned").outcome, verdict.exit_code

    assert ended("duration reached") == (PASSED, 0)
    assert ended("state not finite") == (FAILED, 1)
    assert ended("CAN lost") == (FAILED, 4)
    assert ended("deadline budget exceeded") == (FAILED, 3)
    assert ended("of another version") == (NOT_JUDGED, 1)


def test_tracking_follows_a_reference_file(tmp_path):
    times = np.arange(0, TICKS * 1e-3 + 0.1, 0.01)
    reference = tmp_path / "reference.csv"
    rows = "\n".join(f"{t:.3f},{600 + 20 * np.sin(2 * np.pi * t / 8) + 0.25:.6f}" for t in times)
    reference.write_text(f"time_s,lift_mm\n{rows}\n")
    limits = "tracking_error_mm_max = 0.26\ntracking_error_mm_rms = 0.2"
    report = report_of(tmp_path, limits, reference)
    outcomes = {one.key: one for one in report.verdict.judgements}
    assert outcomes["tracking_error_mm_max"].value == pytest.approx(0.25, abs=2e-3)
    assert outcomes["tracking_error_mm_max"].outcome == PASSED
    assert outcomes["tracking_error_mm_rms"].outcome == FAILED


def test_settling_is_timed_from_the_stop_of_the_valve():
    tick = np.arange(2000)
    valve = np.where((tick < 500) | ((tick >= 1000) & (tick < 1300)), 0.5, 0.0)
    speed = np.where(valve > 0, 10.0, 0.0)
    speed[500:540] = 3.0  # 40 ms of ringing behind the first stop
    rows = plant_use.settling_times_ms(tick, valve, speed, 1_000_000, 0.5)
    assert rows.tolist() == [[39.0, 1.0], [0.0, 1.0]]
    speed[1300:] = 2.0
    assert plant_use.settling_times_ms(tick, valve, speed, 1_000_000, 0.5)[1].tolist() == [699.0, 0.0]
    crossing = np.where(tick < 1000, 0.5, -0.5)
    crossing[1000:1005] = 0.0
    assert len(plant_use.settling_times_ms(tick, crossing, speed, 1_000_000, 0.5)) == 0


def test_junit_carries_every_limit(tmp_path):
    limits = "rod_speed_mmps_max = 1.0\npressure_mpa_max = 30.0\ntracking_error_mm_max = 1.0\ncheck_failures_max = 7"
    report = report_of(tmp_path, limits)
    text = junit_xml(report.verdict, "suite <1>", 3.0, {"note": "a\x07b & c"})
    suite = ElementTree.fromstring(text.encode()).find("testsuite")
    count = str(len(report.verdict.judgements))
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == (count, "1", "1")
    cases = {case.get("name"): case for case in suite.iter("testcase")}
    assert "18 against 1 mm/s" in cases["rod_speed_mmps_max"].find("failure").get("message")
    assert cases["tracking_error_mm_max"].find("error") is not None
    assert cases["pressure_mpa_max"].find("failure") is None
    assert suite.find("properties/property").get("value") == r"a\x07b & c"


def outcomes_of(report) -> dict[str, str]:
    return {one.key: one.outcome for one in report.verdict.judgements}


def test_no_limits_is_not_passed(tmp_path):
    verdict = report_of(tmp_path, "settling_speed_mmps = 0.5", edit=None).verdict
    assert (verdict.outcome, verdict.passed, verdict.exit_code) == (NO_LIMITS, False, 0)


def test_a_missing_end_of_the_log_is_judged_in_every_figure(tmp_path):
    """The ring was full until the end: what is judged says over how much, and what is missing fails."""
    report = report_of(tmp_path, "pressure_mpa_max = 30.0", metadata={"run": {"dropped_ticks": "8111"}}, edit=None)
    (pressure,) = [one for one in report.verdict.judgements if one.key == "pressure_mpa_max"]
    assert pressure.outcome == PASSED and pressure.over == "over 3584 of 11695 ticks"
    assert report.verdict.exit_code == 1
    assert [cause for cause in report.verdict.causes if "ticks_lost_max: failed: 8111 against 0 ticks" in cause]
    assert report_of(
        tmp_path, "ticks_lost_max = 8111", metadata={"run": {"dropped_ticks": "8111"}}, edit=None
    ).verdict.passed


def test_refused_frames_are_counted_by_the_loop_not_by_the_log(tmp_path):
    """A log that lost frames does not know how many were refused; the loop's own counters stand at its end."""
    metadata = {"frames": {"lift.bad crc": "70000"}}
    report = report_of(tmp_path, "frames_rejected_max = 5\nframes_lost_max = 1e9", metadata=metadata)
    (rejected,) = [one for one in report.verdict.judgements if one.key == "frames_rejected_max"]
    assert (rejected.outcome, rejected.value) == (FAILED, 70000)


def test_a_field_the_log_does_not_have_is_not_judged_as_zero(tmp_path):
    path = synthetic_run.write_run(tmp_path / "run.mcap", 500, profile_text=profile("end_stop_ticks_max = 0"))
    other = copy_with(
        path, tmp_path / "other.mcap", schema=lambda text: text.replace(b"uint32 flags #", b"uint32 fl4gs #")
    )
    report = build_report(other)
    assert outcomes_of(report)["end_stop_ticks_max"] == NOT_JUDGED
    assert any("no /lift/state flags" in cause for cause in report.verdict.causes)
    assert outcomes_of(build_report(path))["end_stop_ticks_max"] == PASSED


def test_an_axis_without_a_logged_state_is_not_judged(tmp_path):
    text = profile("").replace("[limits]", '[[axis]]\nname = "slew"\n[limits]') + "pressure_mpa_max = 30.0"
    report = build_report(synthetic_run.write_run(tmp_path / "run.mcap", 500, profile_text=text))
    assert outcomes_of(report)["pressure_mpa_max"] == NOT_JUDGED
    assert any("no state of axis slew" in cause for cause in report.verdict.causes)


def test_a_cross_check_that_stopped_does_not_pass(tmp_path):
    check = {
        "lift.checked_ticks": "300",
        "lift.restart_count": "0",
        "left_out_ticks": "0",
        "error": "MemoryError: no room",
    }
    verdict = report_of(tmp_path, "pressure_mpa_max = 30.0", metadata={"check": check}, edit=None).verdict
    assert verdict.exit_code == 1
    assert any("unchecked_ticks_max" in cause and "MemoryError" in cause for cause in verdict.causes)


def test_a_sustained_error_that_no_record_flags_fails(tmp_path):
    """The recorder tells the first tick of any failure at the end."""
    check = {"lift.checked_ticks": "99999", "lift.failed_tick": "1234", "error": ""}
    verdict = report_of(tmp_path, "pressure_mpa_max = 30.0", metadata={"check": check}, edit=None).verdict
    assert verdict.exit_code == 5
    assert any("axis lift from tick 1234 on" in cause for cause in verdict.causes)
