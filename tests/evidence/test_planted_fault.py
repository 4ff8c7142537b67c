"""One weight of the surrogate times 1.01: the run that used it is told apart from a healthy one, online and in the replay."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from hilrunner.base import exit_codes, status
from hilrunner.evidence.reader import read_run
from hilrunner.setup import resources
from hilrunner.setup.profile import load_profile

FACTOR = 1.01
HERE = Path(__file__).parent
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


def largest_mpa(summary: dict, kind: str) -> float:
    """Of both chambers: the largest error of the free run (""), or of its mean ("sustained_")."""
    found = summary["recorder"]["check"]["luffing"]
    return max(found[f"{kind}chamber_{number}_pressure_error_pa_max"] for number in (1, 2)) * 1e-6


@pytest.mark.parametrize(
    "commands, duration_s, peak_share, sustained_share",
    [("hard_commands.csv", 9.9, 0.02, 0.005), ("chattering_commands.csv", 6.0, 0.02, 0.05)],
)
def test_the_hardest_commands_are_no_fault(tmp_path, commands, duration_s, peak_share, sustained_share):
    """What is left of missing spool mass stays well within the tolerances, and these are not far above it: that would hide faults."""
    code, summary = hilrunner(
        tmp_path, "run", "--stimulus", str(HERE / commands), "--duration", str(duration_s), "--log", "run.mcap",
    )  # fmt: skip
    assert code == exit_codes.PASSED, summary
    rules = load_profile("amc-lift").profile.crosscheck
    assert largest_mpa(summary, "") > peak_share * rules.pressure_tolerance_mpa
    assert largest_mpa(summary, "sustained_") > sustained_share * rules.sustained_pressure_tolerance_mpa


def test_a_stop_from_sinking_traps_no_error(tmp_path):
    """What a closing spool lets through too much would stay in the shut chambers until the valve opens again."""
    stop = tmp_path / "stop.csv"
    stop.write_text("time_s,valve_command\n0,-0.19\n1,-0.19\n1.001,0\n4,0\n")
    code, summary = hilrunner(tmp_path, "run", "--stimulus", str(stop), "--duration", "4", "--log", "run.mcap")
    assert code == exit_codes.PASSED, summary
    check = read_run(tmp_path / "run.mcap").check["luffing"]
    assert np.abs(check["chamber_2_pressure_error_pa"][-500:]).max() < 50.0  # 1000 Pa and more without the spools' mass


@pytest.mark.parametrize("position_mm, command", [(30.0, -1.0), (1970.0, 1.0)])
def test_an_end_stop_hit_and_a_command_that_chatters_are_no_fault(tmp_path, position_mm, command):
    """Into the stop at full speed, off it again, and to a standstill by a command that chatters every other millisecond."""
    profile = with_planted_fault(tmp_path, None)
    profile.write_text(
        profile.read_text().replace("initial_position_mm = 600.0", f"initial_position_mm = {position_mm}")
    )
    rows = [(0, command), (2.5, command), (2.501, -command), (3.0, -command)]
    rows += [(3.0 + 0.002 * k + 0.001, 0.4 * (k % 2)) for k in range(250)]
    lines = [f"{time_s:.3f},{value}" for time_s, value in rows] + ["3.6,0", "4.0,0"]
    (tmp_path / "hit.csv").write_text("time_s,valve_command\n" + "\n".join(lines) + "\n")
    code, summary = hilrunner(
        tmp_path, "run", "--profile", str(profile), "--stimulus", "hit.csv", "--duration", "4", "--log", "run.mcap",
    )  # fmt: skip
    run = read_run(tmp_path / "run.mcap")
    assert (run.state["luffing"]["flags"] & status.FLAG_END_STOP).any()
    assert code == exit_codes.PASSED, summary
    assert largest_mpa(summary, "") < 0.002


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
