"""The compiled integrators against independent ones: IDA on the residual, scipy's DOP853, and their own order."""

import numpy as np
import plant_cases
import pytest
from scipy.integrate import solve_ivp

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.base.errors import StateError
from hilrunner.plant import ida, load, residual, stability, step

PAPER, LIFT, LINES = status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES
STATES = [0, 1, 2, 3]
MPA, MM = 1e6, 1e-3


def moving_start(circuit, fast=False):
    """A state in the middle of a motion, nothing touching a stop but the open spool, away from every kink."""
    plant = plant_cases.plant(circuit, fast=fast, substep_count=200)
    states, _ = plant_cases.run(plant, np.full(100, 0.5))
    return states[-1]


@pytest.mark.parametrize(
    ("circuit", "fast"), [(PAPER, False), (PAPER, True), (LIFT, False), (LIFT, True), (LINES, False)]
)
def test_runge_kutta_converges_with_order_four(circuit, fast):
    """The oil column rings on after a step of the command; errors of the pressures against 320 substeps."""
    start = moving_start(circuit, fast)
    commands = np.full(20, 0.55)  # the check valve stays half open: no kink within the run
    counts = np.array([16, 20, 25, 32])
    exact, _ = plant_cases.run(plant_cases.plant(circuit, fast=fast, substep_count=320), commands, start=start)
    errors = []
    for count in counts:
        plant = plant_cases.plant(circuit, fast=fast, substep_count=int(count))
        states, _ = plant_cases.run(plant, commands, start=start)
        errors.append(np.sqrt(np.mean((states - exact)[:, [2, 3]] ** 2)))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.1), errors


@pytest.mark.parametrize("case", plant_cases.CASES, ids=lambda case: case.name)
def test_compiled_reference_is_within_a_millionth_of_ida(case):
    """Seconds here, whole runs in tools/certify_plant: 20 substeps against IDA at rtol 1e-11."""
    case = case.shortened(1.5 if case.wave_n else 2.5)
    commands, scales, start = case.commands(), case.load_scales(), case.start()
    truth = ida.solve_ida(case.plant(), commands, scales, plant_cases.PERIOD_S, start, rtol=1e-11)
    states, _ = plant_cases.run(case.plant(substep_count=20), commands, scales, start)
    worst = np.abs(states - truth).max(axis=0)
    assert np.ptp(truth[:, 0]) > 1e-4
    assert worst[[2, 3]].max() < 1e-6 * MPA
    assert worst[0] < 1e-6 * MM


@pytest.mark.parametrize("circuit", [PAPER, LIFT, LINES])
def test_compiled_reference_agrees_with_ida_where_the_oil_tears(circuit):
    """A load that pulls the rod out and pushes it back with both valves shut: a void opens in chamber 1, is filled and collapses."""
    plant = plant_cases.plant(circuit, table=load.constant(-6e5), substep_count=80)
    start = step.initial_state(plant_cases.plant(circuit, table=load.constant(0.0)), 0.6)
    times = plant_cases.times(0.3)
    commands, scales = np.zeros(len(times)), np.sin(2 * np.pi * 5.0 * times)
    states, flags = plant_cases.run(plant, commands, scales, start)
    truth = ida.solve_ida(plant, commands, scales, plant_cases.PERIOD_S, start, rtol=1e-11)
    torn = flags & status.FLAG_CAVITATION != 0
    assert 10 < np.count_nonzero(torn) < len(torn) - 10 and truth[:, 2].min() > -101_325.0
    error = np.abs(states - truth)
    assert error[:, [2, 3]].max() < 1e-3 * MPA and error[:, 0].max() < 1e-4 * MM
    assert error[torn][:, 2].max() < 50.0


def test_reference_agrees_with_scipy():
    plant = plant_cases.plant(PAPER)
    places = list(stability.active_places(PAPER, False))
    start = moving_start(PAPER)

    def rates(_, y):
        state, out = np.zeros((1, 10)), np.empty((1, 10))
        state[0, places] = y
        stability.state_rates(plant.parameters, plant.load.record(), 1.0, PAPER, False, 0.7, state, out)
        return out[0, places]

    solved = solve_ivp(
        rates, (0.0, 0.03), start[places], "DOP853", rtol=1e-11, atol=1e-12 * np.abs(start[places]) + 1e-15
    )
    states, _ = plant_cases.run(plant_cases.plant(PAPER, substep_count=40), np.full(30, 0.7), start=start)
    gap = np.abs(states[-1, places] - solved.y[:, -1])
    assert gap[2] < 1e-6 * MPA and gap[3] < 1e-6 * MPA and gap[0] < 1e-7 * MM


@entry
def _residual(plant, y, dy, r):
    residual.residual(plant[0], y, dy, r)


@entry
def _consistent(plant, y, dy):
    return residual.make_consistent(plant[0], y, dy)


@pytest.mark.parametrize("circuit", [PAPER, LIFT, LINES])
@pytest.mark.parametrize("command", [0.0, 0.03, 0.6, 1.0, -0.03, -0.7])
def test_residual_and_right_hand_side_are_the_same_model(circuit, command):
    """Random states: with the eliminated algebraic unknowns and the rates put in, every row of the residual vanishes."""
    generator = np.random.default_rng(11)
    plant = np.zeros(1, residual.PLANT_INPUT)
    axis = plant_cases.plant(circuit)
    plant["circuit"], plant["valve_command"], plant["load_scale"] = circuit, command, 1.03
    plant["parameters"], plant["load"] = axis.parameters[0], axis.load.record()[0]
    places = residual.UNKNOWNS[circuit]
    for _ in range(40):
        state = np.zeros(10)
        lowest = generator.choice([2e5, -1e5])  # half of them may hold a void
        state[:4] = generator.uniform([0.05, -0.03, lowest, lowest], [1.95, 0.03, 12e6 if lowest > 0 else 0.0, 6e6])
        state[4:6] = generator.uniform(-2e-4, 4.3e-3, 2)
        state[6:8] = generator.normal(0, 0.02, 2)
        state[8:10] = generator.uniform(3e5, 12e6, 2)
        y, dy, r = state[list(places)], np.zeros(len(places)), np.zeros(len(places))
        _consistent(plant, y, dy)
        _residual(plant, y, dy, r)
        algebraic = len(places) - residual.ALGEBRAIC_COUNT[circuit]
        assert np.all(np.abs(r[:algebraic]) <= 1e-12 * (1.0 + np.abs(dy[:algebraic])))
        assert np.all(np.abs(r[algebraic:]) < 1.0)  # of pressure rates of 1e9 Pa/s
        # and the rates of the eliminated model
        state[list(places)] = y
        rates = np.empty((1, 10))
        stability.state_rates(axis.parameters, axis.load.record(), 1.03, circuit, False, command, state[None], rates)
        expected = dy[:algebraic]
        got = rates[0, list(places)][:algebraic]
        if circuit == PAPER:
            expected, got = dy[:6], rates[0, [0, 1, 2, 3, 5, 7]]
        assert np.allclose(got, expected, rtol=1e-6, atol=2e2)


def test_ida_says_when_it_gives_up():
    plant = plant_cases.plant(LIFT)
    start = step.initial_state(plant, 0.6)
    with pytest.raises(StateError, match="gave up with command 0.5"):
        ida.solve_ida(plant, [0.5, 0.5], [1.0, np.nan], 1e-3, start)


def test_ida_reports_progress_and_repeats_itself():
    plant = plant_cases.plant(LIFT)
    start = step.initial_state(plant, 0.6)
    seen: list[int] = []
    commands, scales = np.full(600, 0.5), np.ones(600)
    one = ida.solve_ida(plant, commands, scales, 1e-3, start, progress=seen.append)
    two = ida.solve_ida(plant, commands, scales, 1e-3, start)
    assert seen[-1] == 600 and len(seen) > 1 and seen == sorted(seen)
    assert np.array_equal(one, two)


def test_mass_free_spools_are_as_good_as_measured():
    """Fast mode: below 1e-3 MPa while lifting, holding, lowering and under an overrunning load."""
    for name, duration_s in (("lift: lift-hold-lower-hold", 6.0), ("lift: overrunning -150 kN, waves", 4.0)):
        case = plant_cases.case_named(name).shortened(duration_s)
        commands, scales, start = case.commands(), case.load_scales(), case.start()
        exact, _ = plant_cases.run(case.plant(substep_count=20), commands, scales, start)
        fast, _ = plant_cases.run(case.plant(fast=True), commands, scales, start)
        assert 0.0 < np.abs(fast - exact)[:, [2, 3]].max() < 1e-3 * MPA


def test_quasi_static_spool_is_exact_on_its_stop_and_diverges_where_it_modulates():
    """The article's own reduction, judged by its eigenvalues at a steady overrunning state."""
    plant = plant_cases.plant(PAPER, table=load.constant(-3.5e5))
    state = step.initial_state(plant, 0.5, 0.6)
    assert 0.0 < state[5] < 4e-3  # modulates
    full = stability.eigenvalues(plant, state[None], 0.6)[0]
    assert full.real.max() < 1.0
    reduced = plant_cases.quasi_static_eigenvalues(plant, state, 0.6)
    pair = reduced[np.abs(reduced.imag) > 300]
    assert len(pair) == 2 and np.all(pair.real > 5.0)
