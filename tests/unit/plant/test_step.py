"""The step the loop calls: determinism, flags, clipping, several axes, and the same numbers without a compiler."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import plant_cases
import pytest

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.base.errors import ProfileError
from hilrunner.plant import load, step

PAPER, LIFT, LINES = status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES
VARIANTS = [(PAPER, False), (PAPER, True), (LIFT, False), (LIFT, True), (LINES, False)]


@entry
def _one(model, axis, command, scale, state, scratch):
    return step.advance(model, axis, command, scale, 1e-3, state, scratch)


@entry
def _force(model, axis, x, scale):
    return step.current_load_force(model, axis, x, scale)


def commands(count=400):
    return 0.7 * np.sin(np.arange(count) * 0.02) + 0.1


@pytest.mark.parametrize(("circuit", "fast"), VARIANTS)
def test_two_runs_are_equal_bit_by_bit(circuit, fast):
    plant = plant_cases.plant(circuit, fast=fast)
    one, _ = plant_cases.run(plant, commands())
    two, _ = plant_cases.run(plant, commands())
    assert one.tobytes() == two.tobytes() and np.isfinite(one).all()


@pytest.mark.parametrize(("circuit", "fast"), VARIANTS)
def test_many_periods_are_single_periods_in_a_row(circuit, fast):
    plant = plant_cases.plant(circuit, fast=fast)
    many, flags = plant_cases.run(plant, commands(50))
    model, state, scratch = step.assemble([plant]), step.initial_state(plant, 0.6), np.zeros(step.SCRATCH_SIZE)
    for i, command in enumerate(commands(50)):
        assert _one(model, 0, command, 1.0, state, scratch) == flags[i]
        assert state.tobytes() == many[i].tobytes()


def test_axes_do_not_touch_each_other():
    axes = [plant_cases.plant(LIFT), plant_cases.plant(PAPER), plant_cases.plant(LINES, table=load.constant(6e5))]
    model, scratch = step.assemble(axes), np.zeros(step.SCRATCH_SIZE)
    states = np.array([step.initial_state(axis, 0.6) for axis in axes])
    for command in commands(30):
        for index in range(3):
            _one(model, index, command, 1.0, states[index], scratch)
    for index, axis in enumerate(axes):
        alone, _ = plant_cases.run(axis, commands(30))
        assert states[index].tobytes() == alone[-1].tobytes()


def test_commands_beyond_full_act_as_full():
    plant = plant_cases.plant(LIFT)
    assert np.array_equal(plant_cases.run(plant, [3.0] * 5)[0], plant_cases.run(plant, [1.0] * 5)[0])
    assert np.array_equal(plant_cases.run(plant, [-9.0] * 5)[0], plant_cases.run(plant, [-1.0] * 5)[0])
    paper = plant_cases.plant(PAPER)
    assert np.array_equal(plant_cases.run(paper, [-0.5] * 5)[0], plant_cases.run(paper, [0.0] * 5)[0])


def test_the_model_is_read_only():
    model = step.assemble([plant_cases.plant(LIFT)])
    for array in (model.parameters, model.load, model.substep_count, model.circuit):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[0]


@pytest.mark.parametrize(("circuit", "fast"), VARIANTS)
@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_a_state_that_is_no_number_is_flagged(circuit, fast, place):
    plant = plant_cases.plant(circuit, fast=fast)
    start = step.initial_state(plant, 0.6)
    start[place] = np.nan
    _, flags = plant_cases.run(plant, [0.5], start=start)
    assert flags[0] & status.FLAG_NOT_FINITE


def test_flags_tell_end_stop_and_cavitation():
    plant = plant_cases.plant(LIFT)
    start = step.initial_state(plant, 2.0)
    _, flags = plant_cases.run(plant, [1.0] * 400, start=start)
    assert flags[-1] & status.FLAG_END_STOP and not flags[-1] & status.FLAG_NOT_FINITE
    start = step.initial_state(plant, 0.6)
    start[3] = -0.09e6
    _, flags = plant_cases.run(plant, [0.0], start=start)
    assert flags[0] & status.FLAG_CAVITATION
    _, flags = plant_cases.run(plant, commands())
    assert not flags.any()


def test_load_force_is_scaled():
    model = step.assemble([plant_cases.plant(LIFT)])
    assert _force(model, 0, 1.0, 1.5) == pytest.approx(1.5 * 724_320, rel=1e-4)


def test_no_axis_is_refused():
    with pytest.raises(ProfileError, match="one or more"):
        step.assemble([])


def test_warm_start_does_not_decide_the_answer():
    plant = plant_cases.plant(LIFT)
    start = step.initial_state(plant, 0.6)
    other = start.copy()
    other[8], other[9] = 29e6, 1e5  # guesses only
    one, _ = plant_cases.run(plant, commands(), start=start)
    two, _ = plant_cases.run(plant, commands(), start=other)
    assert np.abs(one - two)[:, [2, 3, 8, 9]].max() < 0.5


_WITHOUT_JIT = """
import json, sys
import numpy as np
import plant_cases
out = {}
for circuit, fast in json.loads(sys.argv[1]):
    plant = plant_cases.plant(circuit, fast=fast, substep_count=5 if fast else 14)
    start = np.array(json.loads(sys.argv[2])[f"{circuit}{fast}"])
    out[f"{circuit}{fast}"] = plant_cases.run(plant, [0.5, -0.5, 0.0], start=start)[0].tolist()
print(json.dumps(out))
"""


def test_without_a_compiler_the_same_numbers():
    starts = {}
    for circuit, fast in VARIANTS:
        plant = plant_cases.plant(circuit, fast=fast)
        starts[f"{circuit}{fast}"] = plant_cases.run(plant, commands(20))[0][-1].tolist()
    tests = Path(__file__).resolve().parents[2]
    environment = {
        **os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(tests.parent), str(tests / "tools")])
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT_JIT, json.dumps(VARIANTS), json.dumps(starts)],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    interpreted = json.loads(done.stdout)
    for circuit, fast in VARIANTS:
        plant = plant_cases.plant(circuit, fast=fast, substep_count=5 if fast else 14)
        compiled, _ = plant_cases.run(plant, [0.5, -0.5, 0.0], start=starts[f"{circuit}{fast}"])
        assert np.allclose(interpreted[f"{circuit}{fast}"], compiled, rtol=1e-12, atol=1e-12)
