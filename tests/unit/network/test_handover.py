"""Periods that the surrogate hands over to the exact engine: what that mends, how often it happens, and where it never does."""

from dataclasses import replace

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.plant import handover, load, step
from hilrunner.plant.parameters import make_parameters
from hilrunner.plant.schedule import SCHEDULES
from hilrunner.setup import resources
from hilrunner.setup.model import load_model

PERIOD_S = 1e-3
EXACT_SUBSTEPS = 20


def surrogate(preset="lift", model="lift-flow.onnx", table=None, **fields):
    circuit = status.CIRCUIT_NAMES.index("paper" if preset == "paper" else "lift")
    record = make_parameters(preset, {})
    networks, _ = load_model(resources.models_folder() / model, status.CIRCUIT_NAMES[circuit], record)
    kept = {"exact_substep_count": EXACT_SUBSTEPS, "substep_count": 5, **fields}
    return step.AxisPlant(
        circuit, record, table or load.knuckle_boom(), engine=status.ENGINE_SURROGATE, networks=networks, **kept
    )


def run(axis, commands, position_m):
    """(states, flags) over commands, one a period."""
    model, state = step.assemble([axis]), step.initial_state(axis, position_m)
    states, flags = np.zeros((len(commands), 10)), np.zeros(len(commands), np.int64)
    ones, scratch = np.ones(len(commands)), np.zeros(step.SCRATCH_SIZE)
    step.advance_many(model, 0, np.asarray(commands, float), ones, PERIOD_S, state, scratch, states, flags)
    return states, flags


def error_mpa(axis, commands, position_m):
    """Largest pressure error against the exact engine, MPa, and the share of the periods handed over."""
    exact = replace(
        axis, engine=status.ENGINE_REFERENCE, networks=None, substep_count=EXACT_SUBSTEPS, exact_substep_count=0
    )
    mine, flags = run(axis, commands, position_m)
    truth, _ = run(exact, commands, position_m)
    return np.abs(mine - truth)[:, 2:4].max() / 1e6, np.mean(flags & status.FLAG_EXACT_STEP != 0)


CHATTER = np.tile([0.4, 0.4, 0.0, 0.0, 0.0], 400)
INTO_THE_STOP = np.concatenate([np.full(1200, -1.0), np.full(600, 1.0), np.zeros(200)])


@pytest.mark.parametrize(
    ("commands", "position_m", "reduced_mpa", "allowed_mpa"),
    [(CHATTER, 0.6, 0.02, 1e-3), (INTO_THE_STOP, 0.01, 0.02, 2e-3)],
    ids=["chattering command", "into the end stop, and back at full speed"],
)
def test_what_spools_without_mass_cost_is_gone(commands, position_m, reduced_mpa, allowed_mpa):
    axis = surrogate()
    mended, _ = error_mpa(axis, commands, position_m)
    reduced, share = error_mpa(replace(axis, exact_substep_count=0), commands, position_m)
    assert reduced > reduced_mpa and share == 0.0, "else nothing was mended"
    assert mended < allowed_mpa


def test_ordinary_work_is_done_by_the_networks():
    schedule = SCHEDULES["lift-hold-lower-hold"]
    commands = schedule.values(np.arange(20_000) * PERIOD_S)
    error, share = error_mpa(surrogate(), commands, 0.6)
    assert 0.0 < share < 0.01 and error < 1e-4


def test_a_chamber_that_empties_within_a_period_is_computed_again():
    """The period begins well filled, so the networks take it, and is thrown away when it ends below the tank."""
    axis = surrogate(table=load.constant(-1e5))
    model, scratch = step.assemble([axis]), np.zeros(step.SCRATCH_SIZE)
    state = step.initial_state(axis, 0.6)
    state[1], state[2] = 0.3, 0.4e6
    before, exact = state.copy(), state.copy()
    flags = handover.advance_with_handover(model, 0, 0.0, 1.0, PERIOD_S, state, scratch)
    alone = replace(axis, engine=status.ENGINE_REFERENCE, networks=None, substep_count=EXACT_SUBSTEPS)
    step.advance_reference(step.assemble([alone]), 0, 0.0, 1.0, PERIOD_S, exact)
    assert before[2] > axis.parameters["tank_pressure_pa"][0] + 0.1e6 > exact[2]
    assert flags & status.FLAG_EXACT_STEP and state.tobytes() == exact.tobytes()


def test_none_is_handed_over_where_the_axis_says_so():
    plain, flags = run(surrogate(exact_substep_count=0), CHATTER[:300], 0.6)
    assert not np.any(flags & status.FLAG_EXACT_STEP) and np.isfinite(plain).all()


def test_the_articles_own_form_of_network_is_left_as_it_is():
    commands = np.tile([0.4, 0.4, 0.0, 0.0], 25)
    mine, flags = run(surrogate("paper", "paper-rates.onnx"), commands, 0.6)
    alone, _ = run(surrogate("paper", "paper-rates.onnx", exact_substep_count=0), commands, 0.6)
    assert mine.tobytes() == alone.tobytes() and not np.any(flags & status.FLAG_EXACT_STEP)


def test_the_flag_stays_off_the_bus():
    assert not status.BUS_FLAGS & status.FLAG_EXACT_STEP
