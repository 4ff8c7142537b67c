"""What was understood of a stimulus stands in the output of simulate and check, in their JSON, and in the log."""

import json

import pytest

from hilrunner.cli import main
from hilrunner.evidence.reader import read_run

FULL_OUT = "C522004078563412"  # golden: Active, 100 %, counter 2


@pytest.fixture
def profile(tmp_path):
    """A profile whose schedule is a CAN log with a cut end and a gap in which the command ages."""
    (tmp_path / "rec.log").write_text(f"(7.000) can0 201#{FULL_OUT}\n(7.060) can1 123#00\n(7.1")
    path = tmp_path / "mine.toml"
    path.write_text(
        'name = "mine"\n[stimulus]\nschedule = "rec.log"\n[[axis]]\nname = "boom"\nmodel = "lift-flow.onnx"\n'
    )
    return path


def test_the_line_the_json_and_the_log(profile, tmp_path, capsys):
    log = tmp_path / "run.mcap"
    assert main(["simulate", "--profile", str(profile), "--out", str(log)]) == 0
    told = capsys.readouterr().out
    line = next(one.strip() for one in told.splitlines() if one.strip().startswith("stimulus "))
    assert line.endswith(
        "rec.log: candump, 0.060 s, 2 frames, 1 valid commands on channel can0 (of can0, can1); 61 periods"
    )
    assert "warning: its last line is cut: '(7.1'" in told and "the command aged as on a bus" in told
    assert read_run(log).metadata["run"]["stimulus"] == line
    assert main(["check", str(profile), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["stimulus"]["valid_count"] == {"boom": 1} and found["stimulus"]["channels"] == ["can0", "can1"]
    assert any("its last line is cut" in one for one in found["warnings"])
    assert main(["check", str(profile)]) == 0
    assert line in capsys.readouterr().out
