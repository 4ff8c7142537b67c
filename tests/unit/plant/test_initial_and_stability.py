"""States to start from are steady; refusals name what is wrong; stability limits match what integration does."""

import math
from dataclasses import replace

import numpy as np
import plant_cases
import pytest

from hilrunner.base import status
from hilrunner.base.errors import ProfileError, StateError
from hilrunner.plant import initial, load, stability, step

PAPER, LIFT, LINES = status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES


def rates_of(plant, state, command):
    out = np.empty((1, 10))
    stability.state_rates(
        plant.parameters, plant.load.record(), 1.0, plant.circuit, plant.fast, command, state[None], out
    )
    return out[0]


@pytest.mark.parametrize("circuit", [PAPER, LIFT, LINES])
@pytest.mark.parametrize("command", [0.0, 0.1, 0.6, 1.0, -0.1, -0.5, -1.0])
@pytest.mark.parametrize("position_m", [0.1, 0.6, 1.9])
def test_initial_states_are_steady(circuit, command, position_m):
    if circuit == PAPER and command < 0:
        return
    plant = plant_cases.plant(circuit, table=load.constant(7e5))
    state = initial.initial_state(plant, position_m, command)
    rates = rates_of(plant, state, command)
    assert np.sign(state[1]) == np.sign(command)
    assert rates[0] == state[1]
    assert abs(rates[1]) < 1e-3  # m/s^2
    assert np.all(np.abs(rates[2:4]) < 1e3)  # Pa/s, on 7e8 Pa of stiffness
    assert np.all(np.abs(rates[6:8]) < 1e-4)


@pytest.mark.parametrize(
    ("command", "speed_mmps", "p1", "p2", "line_a", "line_b"),
    [
        # plateaus of lift-hold-lower-hold near x = 600 mm as first measured by other code (docs/paper.md, lift)
        (0.6, 13.7, 9.127, 0.613, 9.44, 0.576),
        (1.0, 22.5, 9.158, 0.663, 9.98, 0.565),
        (-0.5, -11.15, 9.219, 0.752, 1.167, 0.960),
        (-1.0, -22.25, 9.220, 0.766, 1.162, 1.073),
    ],
)
def test_steady_states_of_lift(command, speed_mmps, p1, p2, line_a, line_b):
    state = initial.initial_state(plant_cases.plant(LIFT), 0.6, command)
    assert state[1] * 1e3 == pytest.approx(speed_mmps, abs=0.1)
    assert state[[2, 3, 8, 9]] / 1e6 == pytest.approx([p1, p2, line_a, line_b], abs=0.02)


def test_steady_state_with_both_spools_open_and_not_vented():
    heavy_load = plant_cases.plant(LIFT, table=load.constant(8.5e5))
    state = initial.initial_state(heavy_load, 0.6, 1.0)
    assert state[4] > 0 and np.all(np.abs(rates_of(heavy_load, state, 1.0)[1:4]) < 1e3)
    not_vented = plant_cases.plant(LIFT, overrides={"back_pressure_share": 1.0})
    state = initial.initial_state(not_vented, 0.6, -0.5)
    assert np.all(np.abs(rates_of(not_vented, state, -0.5)[1:4]) < 1e3)


def test_a_small_command_that_cannot_lift_is_a_state_of_rest():
    state = initial.initial_state(plant_cases.plant(LIFT), 0.6, 0.02)
    assert state[1] == 0.0 and state[2] == pytest.approx(9.057e6, rel=1e-3)


@pytest.mark.parametrize(
    ("plant", "position_m", "command", "named"),
    [
        (plant_cases.plant(LIFT), 2.1, 0.0, "0 to 2000 mm"),
        (plant_cases.plant(LIFT), math.nan, 0.0, "0 to 2000 mm"),
        (plant_cases.plant(LIFT), 0.6, 1.5, "-1 to 1"),
        (plant_cases.plant(PAPER), 0.6, -0.5, "0 to 1"),
        (plant_cases.plant(LIFT, table=load.constant(1.2e6)), 0.6, 0.0, "1200.0 kN.*opens a counterbalance valve"),
        (plant_cases.plant(LIFT, table=load.constant(-3.5e5)), 0.6, 0.0, "-350.0 kN.*opens a counterbalance valve"),
        (plant_cases.plant(PAPER, table=load.constant(2.6e6)), 0.6, 0.5, "does not move"),
        (plant_cases.plant(PAPER, table=load.constant(-3e6)), 0.6, 1.0, "below absolute vacuum"),
    ],
)
def test_where_no_state_exists_the_error_says_why(plant, position_m, command, named):
    with pytest.raises(StateError, match=named):
        initial.initial_state(plant, position_m, command)


def test_stable_step_of_known_eigenvalues():
    assert stability.stable_step_s(np.array([-1e4 + 0j])) == pytest.approx(2.7853e-4, rel=5e-3)
    assert stability.stable_step_s(np.array([-1e-6 + 1e3j])) == pytest.approx(2.828e-3, rel=5e-3)
    assert stability.stable_step_s(np.array([-100.0 + 0j, -4e4 + 0j])) == pytest.approx(2.7853 / 4e4, rel=5e-3)
    assert stability.stable_step_s(np.array([3.0 + 600j])) == pytest.approx(2.5 / 600, rel=1e-3)
    assert stability.stable_step_s(np.array([0j])) == math.inf


def test_eigenvalues_of_the_article_at_mid_stroke():
    plant = plant_cases.plant(PAPER)
    state = initial.initial_state(plant, 1.0, 0.6)
    values = stability.eigenvalues(plant, state[None], 0.6)[0]
    pair = values[np.abs(np.abs(values.imag) - 663) < 5]
    assert len(pair) == 2 and pair.real == pytest.approx([-4.7, -4.7], abs=0.6)


@pytest.mark.parametrize(("circuit", "fast", "low_us", "high_us"), [
    (PAPER, False, 76, 82), (LIFT, False, 74, 80), (LINES, False, 74, 80), (LIFT, True, 200, 280),
])  # fmt: skip
def test_limits_lie_where_the_spectra_say(circuit, fast, low_us, high_us):
    plant = plant_cases.plant(circuit, fast=fast)
    limit = stability.stability_limit_s(plant)
    assert low_us < limit * 1e6 < high_us
    count = stability.default_substep_count(plant, 1e-3)
    assert 1e-3 / count < limit <= 1e-3 / (count - 1) / stability.SAFETY


def test_integration_is_clean_at_the_limit_and_breaks_well_above_it():
    # lifting presses the spool on its open stop, the stiffest place there is
    def spool(count):
        return plant_cases.run(plant_cases.plant(PAPER, substep_count=count), np.full(300, 0.6))[0][:, 5]

    fine = spool(200)
    chosen = stability.default_substep_count(plant_cases.plant(PAPER), 1e-3)
    assert np.abs(spool(chosen) - fine)[100:].max() < 1e-9
    assert not np.abs(spool(8) - fine)[100:].max() < 1e-7


def test_a_hard_damping_end_stop_makes_the_stalled_rod_the_stiffest_state():
    """Hunt-Crossley damping grows with depth: it counts where full pressure presses the rod in, and nowhere else."""
    ours = plant_cases.plant(status.CIRCUIT_LIFT)
    harder = plant_cases.plant(status.CIRCUIT_LIFT, overrides={"end_stop_damping_spmm": 5e-3})
    assert stability.stability_limit_s(ours) == pytest.approx(76.7e-6, rel=0.01)
    assert stability.stability_limit_s(harder) == pytest.approx(46.3e-6, rel=0.01)
    kept_away = replace(harder, position_range_m=(0.01, 1.99))
    assert stability.stability_limit_s(kept_away) > 70e-6


def test_tiny_dead_volume_needs_tiny_steps_and_a_range_of_positions():
    table_1 = plant_cases.plant(PAPER, "paper-table1", position_range_m=(0.0, 1.0))
    assert stability.stability_limit_s(table_1) < 3e-6
    with pytest.raises(ProfileError, match="dead_volume_1_mm3.*position range"):
        step.assemble([table_1])
    away = plant_cases.plant(PAPER, "paper-table1", position_range_m=(0.005, 1.995))
    assert 55e-6 < stability.stability_limit_s(away) < 70e-6
    assert step.assemble([away]).substep_count[0] == 17
