"""The reduced models with the shipped networks against the first-principle models: error, creep, flags, exact gates."""

from dataclasses import replace

import networks
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.plant import load, network, step, surrogate
from hilrunner.plant.head import FORM_PINNED, FORM_PLAIN
from hilrunner.plant.parameters import make_parameters
from hilrunner.plant.schedule import SCHEDULES
from hilrunner.setup import resources
from hilrunner.setup.model import load_model

PERIOD_S = 1e-3


def axis_of(preset, model, table=None, **parameters):
    circuit = status.CIRCUIT_NAMES.index("paper" if preset == "paper" else "lift")
    record = make_parameters(preset, parameters)
    networks_of_file, _ = load_model(resources.models_folder() / model, status.CIRCUIT_NAMES[circuit], record)
    return step.AxisPlant(
        circuit, record, table or load.knuckle_boom(), engine=status.ENGINE_SURROGATE, substep_count=4,
        networks=networks_of_file,
    )  # fmt: skip


def run(axis, commands, start_m=0.6, scales=None, state=None):
    """(states, flags, scratch) of one axis over commands, one a period."""
    model = step.assemble([axis])
    commands = np.asarray(commands, float)
    scales = np.ones(len(commands)) if scales is None else scales
    states, flags = np.zeros((len(commands), 10)), np.zeros(len(commands), np.int64)
    state = step.initial_state(axis, start_m, 0.0, scales[0]) if state is None else state.copy()
    scratch = np.zeros(step.SCRATCH_SIZE)
    step.advance_many(model, 0, commands, scales, PERIOD_S, state, scratch, states, flags)
    return states, flags, scratch


def exact(axis):
    return replace(axis, engine=status.ENGINE_REFERENCE, networks=None, substep_count=20)


def largest(mine, reference):
    """(p1, p2) in MPa and rod in mm."""
    error = np.abs(mine - reference).max(axis=0)
    return error[2] / 1e6, error[3] / 1e6, error[0] * 1e3


@pytest.mark.parametrize(("preset", "limit_mpa"), [("lift", 5e-4), ("lift-heavy", 3e-3)])
def test_lift_follows_the_first_principle_model_through_lift_hold_lower(preset, limit_mpa):
    axis = axis_of(preset, "lift-flow.onnx")
    t = np.arange(4000) * PERIOD_S
    commands = np.interp(t, [0.2, 0.4, 1.5, 1.6, 2.0, 2.2, 3.4, 3.6], [0, 0.7, 0.7, 0, 0, -0.8, -0.8, 0])
    mine, flags, scratch = run(axis, commands)
    reference, _, _ = run(exact(axis), commands)
    p1, p2, rod = largest(mine, reference)
    assert max(p1, p2) < limit_mpa and rod < 5e-3
    assert not np.any(flags & status.FLAG_OUTSIDE_TRAINING)
    assert scratch[surrogate.SERVED_AT] > 100 * scratch[surrogate.EXACT_AT]


def test_overrunning_load_with_the_valve_modulating():
    axis = axis_of("lift", "lift-flow.onnx", load.constant(-150e3))
    t = np.arange(3000) * PERIOD_S
    commands = np.interp(t, [0.2, 0.5, 1.6, 1.9], [0.0, 0.8, 0.8, -0.5])
    scales = 1.0 + 0.3 * np.sin(2.0 * np.pi * 0.7 * t)
    mine, _, scratch = run(axis, commands, scales=scales)
    reference, _, _ = run(exact(axis), commands, scales=scales)
    p1, p2, rod = largest(mine, reference)
    assert max(p1, p2) < 5e-4 and rod < 5e-3
    opening = mine[:, 5] / axis.parameters["spool_stroke_m"][0]
    assert np.count_nonzero((opening > 0.05) & (opening < 0.95)) > 500, "the valve did not modulate: nothing was tested"
    assert scratch[surrogate.SERVED_AT] > 5 * scratch[surrogate.EXACT_AT]


def test_paper_circuit_over_its_lift_nominal_and_perturbed():
    commands = SCHEDULES["lift-profile"].values(np.arange(9000) * PERIOD_S)
    for table in (load.knuckle_boom(), load.perturbed(load.knuckle_boom(), 0.02, 5)):
        axis = axis_of("paper", "paper-flow.onnx", table)
        mine, flags, _ = run(axis, commands, 0.3)
        reference, _, _ = run(exact(axis), commands, 0.3)
        p1, p2, rod = largest(mine, reference)
        assert p1 < 1e-5 and p2 < 1e-5 and rod < 1e-3
        assert not flags.any()


def test_paper_circuit_with_its_valve_modulating_keeps_the_spool_a_state():
    axis = axis_of("paper", "paper-flow.onnx", load.constant(-120e3), setting_2_mpa=9.0)
    commands = np.interp(np.arange(1500) * PERIOD_S, [0.1, 0.4], [0.0, 0.6])
    mine, _, scratch = run(axis, commands)
    reference, _, _ = run(exact(axis), commands)
    p1, p2, rod = largest(mine, reference)
    assert max(p1, p2) < 5e-3 and rod < 5e-2
    opening = reference[-500:, 5] / axis.parameters["spool_stroke_m"][0]
    assert np.all((opening > 0.0) & (opening < 1.0))
    assert scratch[surrogate.SERVED_AT] > 1000


@pytest.mark.parametrize(("preset", "model"), [("lift", "lift-flow.onnx"), ("paper", "paper-flow.onnx")])
def test_no_creep_is_added_at_neutral(preset, model):
    """Both engines from one settled state, valve neutral: not one bit of difference in the drift's sources."""
    axis = axis_of(preset, model)
    moved, _, _ = run(axis, np.concatenate([np.full(300, 0.5), np.zeros(2000)]))
    fast = replace(axis, engine=status.ENGINE_REFERENCE, networks=None, fast=True)
    held = np.zeros(3000)
    mine, _, _ = run(axis, held, state=moved[-1])
    theirs, _, _ = run(fast, held, state=moved[-1])
    # the chambers are shut: neither volume of oil may change by anything the networks say
    np.testing.assert_allclose(mine[:, :4], theirs[:, :4], rtol=1e-12, atol=1e-9)
    drift = abs(mine[-1, 0] - mine[-1000, 0]) - abs(theirs[-1, 0] - theirs[-1000, 0])
    assert abs(drift) < 1e-15


def test_shut_valves_give_exactly_zero_flow():
    """The gates by themselves: a shut counterbalance valve, and command 0, whatever the networks would answer."""
    axis = axis_of("lift", "lift-flow.onnx")
    model = step.assemble([axis])
    prm = model.parameters[0]
    work = np.zeros(step.SCRATCH_SIZE)
    starts = model.network.axis_start[0]
    context = (model.network.words, starts[network.ROLE_SUPPLY], starts[network.ROLE_RETURN], work)
    for chamber in (0.31e6, 2e6, 14e6):
        line, flow, _ = surrogate.return_line_by_network(context, prm, chamber, 0.0, prm["valve_at_si"], 0.0)
        assert flow == 0.0 and line == prm["tank_pressure_pa"]
    states, _, _ = run(axis_of("paper", "paper-flow.onnx"), np.zeros(200))
    assert np.abs(states[-1, 0] - 0.6) < 1e-12


def test_leaving_the_trained_range_is_flagged_and_served_exactly():
    axis = axis_of("lift", "lift-flow.onnx", load.constant(1.3e6), setting_1_mpa=30.0, supply_pressure_mpa=30.0)
    commands = np.full(600, 0.5)
    mine, flags, scratch = run(axis, commands)
    reference, _, _ = run(exact(axis), commands)
    assert mine[-1, 2] > 15e6 and np.all(flags[1:] & status.FLAG_OUTSIDE_TRAINING)
    p1, p2, rod = largest(mine, reference)
    assert max(p1, p2) < 2e-3 and rod < 5e-3
    assert scratch[surrogate.EXACT_AT] > 1000


def test_an_axis_without_networks_says_so_and_stands_still():
    axis = replace(axis_of("lift", "lift-flow.onnx"), networks=None)
    state = step.initial_state(axis, 0.6)
    model = step.assemble([axis])
    before = state.copy()
    flags = surrogate.advance_surrogate(model, 0, 0.5, 1.0, PERIOD_S, state, np.zeros(step.SCRATCH_SIZE))
    assert flags & status.FLAG_NOT_FINITE
    np.testing.assert_array_equal(state, before)


def plain_network(opening: bool):
    """q_1 = 1e-3, q_2 = -0.5e-3 m^3/s per unit command whatever is asked: a network of a user's own quantities."""
    inputs = 4 if opening else 3
    one = networks.make(inputs, 2, hidden=(3,), activations=(1, 0), seed=1)
    return replace(
        one,
        weights=(np.zeros((3, inputs)), np.zeros((2, 3))), biases=(np.zeros(3), np.array([1e-3, -0.5e-3])),
        output_scale=np.ones(2), output_offset=np.zeros(2),
        input_low=np.full(inputs, -1e9), input_high=np.full(inputs, 1e9), form=FORM_PLAIN if opening else FORM_PINNED,
    )  # fmt: skip


@pytest.mark.parametrize("opening", [False, True])
def test_a_foreign_flow_network_is_asked_in_plain_quantities(opening):
    record = make_parameters("paper")
    nets = network.SurrogateNetworks(network.RECIPE_FLOW, {"flow": plain_network(opening)})
    axis = step.AxisPlant(0, record, load.knuckle_boom(), engine=0, substep_count=4, networks=nets)
    states, _, _ = run(axis, np.full(300, 0.5))
    assert states[-50:, 1].mean() == pytest.approx(0.5e-3 / record["bore_area_m2"][0], rel=0.05)


def test_the_articles_recipe_integrates_the_networks_pressure_rates():
    """A network that answers constant rates: pressures rise by them, whatever the valve does."""
    constant = networks.make(5, 2, hidden=(3,), activations=(1, 0))
    constant = replace(
        constant,
        weights=(np.zeros((3, 5)), np.zeros((2, 3))), biases=(np.zeros(3), np.array([2e5, -1e5])),
        output_scale=np.ones(2), output_offset=np.zeros(2),
        input_low=np.full(5, -1e9), input_high=np.full(5, 1e9),
    )  # fmt: skip
    nets = network.SurrogateNetworks(network.RECIPE_PAPER, {"rates": constant})
    axis = step.AxisPlant(0, make_parameters("paper"), load.knuckle_boom(), engine=0, substep_count=2, networks=nets)
    start = step.initial_state(axis, 0.6)
    states, flags, _ = run(axis, np.full(10, 0.5), state=start)
    np.testing.assert_allclose(states[-1, 2:4] - start[2:4], [2e3, -1e3], rtol=1e-9)
    narrow = replace(constant, input_high=np.array([0.1, 1e9, 1e9, 1e9, 1e9]))
    axis = replace(axis, networks=network.SurrogateNetworks(network.RECIPE_PAPER, {"rates": narrow}))
    _, flags, _ = run(axis, np.full(3, 0.5), state=start)
    assert np.all(flags & status.FLAG_OUTSIDE_TRAINING)
