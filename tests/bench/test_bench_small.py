"""The bench at its smallest size, so that it cannot rot: every part runs, counts what it ran, and prints the same to both readers."""

import json

import numpy as np
import pytest

from hilrunner import cli
from hilrunner.base import status
from hilrunner.bench import capacity, plant_cases
from hilrunner.bench.rosenbrock import Rosenbrock

SMALL = ["--rounds", "1", "--slice-s", "0.05", "--log-s", "0.3"]


def run_bench(capsys, *words: str) -> dict:
    assert cli.main(["bench", "--json", *SMALL, *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_loop_part(capsys):
    found = run_bench(capsys, "--only", "loop")
    assert found["host"]["label"] in ("real-time verified", "best effort")
    lateness = {row[""]: row for row in found["tables"]["lateness"]["rows"]}
    assert {"tick", "tick, spin tail"} <= set(lateness)
    left_out = [note for note in found["tables"]["lateness"]["notes"] if note.startswith("cyclictest ")]
    assert ("cyclictest" in lateness) == (not left_out)
    execution = found["tables"]["execution"]
    assert [row["phase"] for row in execution["rows"]][-3:] == [
        "execution",
        "execution, no rehearsal",
        "execution, spin tail",
    ]
    assert execution["ticks"] >= 100 + 1
    phases = {row["phase"]: row["p50 us"] for row in execution["rows"]}
    assert 0 < phases["step"] < phases["execution"]


def test_log_part_loses_nothing_it_published(capsys):
    log = run_bench(capsys, "--only", "log")["tables"]["log"]
    assert [row[""] for row in log["rows"]] == ["10 kHz", "flat out"]
    assert log["ticks_logged"] == log["ticks_published"] > 0


def test_step_part(capsys):
    tables = run_bench(capsys, "--only", "step")["tables"]
    for name in ("pass_paper_flow", "pass_lift_supply", "pass_lift_return"):
        rivals = {row[""]: row["result"] for row in tables[name]["rows"]}
        assert {"compiled (ours)", "numpy", "onnxruntime, IOBinding"} <= set(rivals)
        assert len(set(rivals.values())) == 1, f"{name}: rivals disagree: {rivals}"
    assert {row["by network"] for row in tables["rk4_step"]["rows"]} == {"100%"}
    for name, pressure_mpa in (("paper", 1e-3), ("lift", 1e-2), ("lift-lines", 1e-4)):
        cases = tables[f"plant_{name}"]["cases"]
        assert all(case["pressure_error_mpa"] < pressure_mpa for case in cases.values()), name
        for rival in ("Radau", "IDA, rtol 1e-09", "Rosenbrock", "exact, RK4 x20"):
            assert any(rival in case for case in cases), rival
        notes = " ".join(tables[f"plant_{name}"]["notes"])
        assert "us allowed" in notes and "MPa allowed" in notes


@pytest.mark.parametrize("circuit", [status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES])
def test_the_rosenbrock_rival_is_of_order_four(circuit):
    """A rival with a mistake in it would be no rival."""
    start = plant_cases.run(plant_cases.plant(circuit, substep_count=200), np.full(100, 0.5))[0][-1]
    held, counts = np.full(20, 0.55), (16, 32, 64)
    exact, _ = plant_cases.run(plant_cases.plant(circuit, substep_count=320), held, start=start)
    rivals = [Rosenbrock(plant_cases.plant(circuit), held, start, count)() for count in counts]
    errors = [np.sqrt(np.mean((states - exact)[:, [2, 3]] ** 2)) for states in rivals]
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(4.0, abs=0.1), errors
    assert errors[-1] < 50.0


def test_capacity_part(capsys, monkeypatch):
    monkeypatch.setattr(capacity, "PERIODS_US", (1000, 500))
    monkeypatch.setattr(capacity, "axis_count_max", lambda: 2)
    tables = run_bench(capsys, "--only", "capacity")["tables"]
    assert [row["axes"] for row in tables["axes"]["rows"]] in ([1], [1, 2])
    assert 0 <= tables["axes"]["axis_count_max"] <= 2
    assert [row["period us"] for row in tables["period"]["rows"]] == [1000, 500]


def test_disturb_part(capsys):
    rows = run_bench(capsys, "--only", "disturb")["tables"]["disturb"]["rows"]
    ticks = [row[""] for row in rows if row[""].endswith(": tick")]
    assert ticks == [
        f"{name}: tick"
        for name in ("quiet", "busy Python thread", "gc.collect() loop", "writer at full speed", "all three")
    ]


def test_text_has_the_same_rows(capsys):
    assert cli.main(["bench", *SMALL, "--only", "loop"]) == 0
    text = capsys.readouterr().out
    assert "a run here is:" in text and "Wake-up lateness at 1000 us" in text and "tick, spin tail" in text
