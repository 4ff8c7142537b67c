"""A log whose end is there but whose closing counts were refused by the disk is not finished: nobody knows what it lacks."""

import synthetic_run

from hilrunner.base import status
from hilrunner.evidence.report import RunnerKnows, build_report


def test_a_log_without_its_closing_counts_does_not_pass(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_run, "_closing", lambda *_: {})
    path = synthetic_run.write_run(tmp_path / "run.mcap", 2000)
    knows = RunnerKnows(2000, status.EXIT_NAMES[status.EXIT_DURATION])
    failed = {one.key for one in build_report(path, knows=knows).verdict.failed}
    assert "log_finished" in failed


def test_a_log_with_them_is_finished(tmp_path):
    path = synthetic_run.write_run(tmp_path / "run.mcap", 2000)
    assert "log_finished" not in {one.key for one in build_report(path).verdict.failed}
