"""One weight of the surrogate times 1.01: the run that used it is told apart from a healthy one, online and in the replay."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from hilrunner.base import exit_codes
from hilrunner.evidence.reader import read_run
from hilrunner.setup import resources
from hilrunner.setup.profile import load_profile

FACTOR = 1.01
HARD_COMMANDS = Path(__file__).parent / "hard_commands.csv"
CHATTERING_COMMANDS = Path(__file__).parent / "chattering_commands.csv"
DURATION_S = 4.0


def with_planted_fault(folder, tensor: str | None):
    """The shipped profile in a folder, its model copied beside it with the largest weight of one tensor a hundredth larger."""
    loaded = load_profile("amc-lift")
    name = loaded.profile.axis[0].model
    model = onnx.load(resources.models_folder() / name)
    for stored in model.graph.initializer:
        if stored.name == tensor:
            weights = numpy_helper.to_array(stored).copy()
            weights.flat[np.abs(weights).argmax()] *= FACTOR
            stored.CopyFrom(numpy_helper.from_array(weights, tensor))
    onnx.save(model, folder / "planted.onnx")
    text = loaded.text.replace(f'"{name}"', '"planted.onnx"')
    assert text != loaded.text
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def hilrunner(folder, *words):
    """(exit code, JSON) of a command."""
    done = subprocess.run(
        [sys.executable, "-m", "hilrunner", *words, "--json"], capture_output=True, text=True, cwd=folder
    )
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout.splitlines()[-1])


def driven(tmp_path, tensor, schedule):
    """A run in real time by a schedule, then its replay."""
    profile = with_planted_fault(tmp_path, tensor)
    ran = hilrunner(
        tmp_path, "run", "--profile", str(profile), "--stimulus", schedule, "--duration", str(DURATION_S), "--log", "run.mcap",
    )  # fmt: skip
    return ran, hilrunner(tmp_path, "replay", "run.mcap"), read_run(tmp_path / "run.mcap")


def test_the_same_file_without_a_fault_passes(tmp_path):
    (code, summary), (replay_code, replay), run = driven(tmp_path, None, "full-lower")
    assert (code, replay_code) == (exit_codes.PASSED, exit_codes.PASSED), summary
    assert replay["dae"][0]["out_of_tolerance_ticks"] == 0
    assert not (run.check["luffing"]["flags"] & 1).any()


def test_the_hardest_commands_are_no_fault(tmp_path):
    """Full reversals and stops within one period: what missing spool mass costs stays within the tolerances."""
    code, summary = hilrunner(
        tmp_path, "run", "--stimulus", str(HARD_COMMANDS), "--duration", "9.9", "--log", "run.mcap",
    )  # fmt: skip
    assert code == exit_codes.PASSED, summary
    found = summary["recorder"]["check"]["luffing"]
    rules = load_profile("amc-lift").profile.crosscheck
    for kind, allowed_mpa in (
        ("", rules.pressure_tolerance_mpa),
        ("sustained_", rules.sustained_pressure_tolerance_mpa),
    ):
        largest_mpa = max(found[f"{kind}chamber_{number}_pressure_error_pa_max"] for number in (1, 2)) * 1e-6
        assert 0.5 * allowed_mpa < largest_mpa < allowed_mpa, (
            "a tolerance far from what healthy networks need hides faults"
        )


def test_a_command_that_chatters_leaves_the_tolerances(tmp_path):
    """Full steps some hundredths of a second apart are beyond spools without mass: the check says so, healthy as the networks are."""
    code, summary = hilrunner(
        tmp_path, "run", "--stimulus", str(CHATTERING_COMMANDS), "--duration", "2", "--log", "run.mcap",
    )  # fmt: skip
    assert code == exit_codes.CROSS_CHECK_FAILED, summary
    found = summary["recorder"]["check"]["luffing"]
    assert 0.003 < found["chamber_2_pressure_error_pa_max"] * 1e-6 < 0.005
    assert any("chamber 2 pressure of the free run" in event.text for event in read_run(tmp_path / "run.mcap").events)


@pytest.mark.parametrize("tensor, schedule", [("supply.weight_3", "full-lower"), ("supply.bias_3", "full-lower")])
def test_a_planted_fault_trips_the_check_and_replay_shows_where(tmp_path, tensor, schedule):
    (code, summary), (replay_code, replay), run = driven(tmp_path, tensor, schedule)
    assert code == exit_codes.CROSS_CHECK_FAILED, summary
    check = run.check["luffing"]
    first = int(check["tick"][np.argmax(check["flags"] & 1 != 0)])
    assert (check["flags"] & 1).any()
    told = [event.text for event in run.events]
    assert any("sustained" in text and f"at tick {first}; allowed" in text for text in told), told
    assert replay_code == exit_codes.CROSS_CHECK_FAILED
    assert replay["exact"]["identical"], "the replay has the planted model as well: the log carries it"
    (axis,) = replay["dae"]
    assert axis["first_out_tick"] == first
    errors = {(error["quantity"], error["comparison"]): error["max"] for error in axis["errors"]}
    pressure = "chamber 2 pressure"
    assert errors[pressure, "run - IDA"] > 100 * errors[pressure, "reference - IDA"], "the fault is the surrogate's"
    assert {place["network"] for place in axis["training_range"]} == {"supply", "return"}
