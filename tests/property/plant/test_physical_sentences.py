"""What any honest hydraulic actuator does, said as tests. Expected values are hand calculations, not recorded results."""

import math
from dataclasses import replace

import numpy as np
import plant_cases
import pytest

from hilrunner.base import status
from hilrunner.plant import load, parameters, step, wave

PAPER, LIFT, LINES = status.CIRCUIT_PAPER, status.CIRCUIT_LIFT, status.CIRCUIT_LIFT_LINES
X, V, P1, P2, S1, S2, LINE_A, LINE_B = 0, 1, 2, 3, 4, 5, 8, 9


def oil_mass(prm, states):
    """Oil of both chambers at constant bulk modulus, relative units: V exp(p / beta)."""
    volume_1 = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * states[:, X]
    volume_2 = prm["dead_volume_2_m3"] + prm["rod_side_area_m2"] * (prm["stroke_m"] - states[:, X])
    beta = prm["bulk_modulus_pa"]
    return volume_1 * np.exp(states[:, P1] / beta), volume_2 * np.exp(states[:, P2] / beta)


@pytest.mark.parametrize("circuit", [PAPER, LIFT])
def test_a_shut_circuit_without_leakage_keeps_its_oil(circuit):
    plant = plant_cases.plant(circuit)
    scales = 1.0 + 0.05 * np.sin(2 * np.pi * 1.3 * plant_cases.times(5.0))
    states, flags = plant_cases.run(plant, np.zeros(5000), scales)
    assert np.ptp(states[:, X]) > 2e-4 and not flags.any()  # it breathes
    for mass in oil_mass(plant.parameters[0], states):
        assert np.ptp(mass) / mass[0] < 1e-11


@pytest.mark.parametrize("fast", [False, True])
def test_the_load_holds_after_a_bounce(fast):
    """The drift of a minute after the bounce has died; an hour is in the certification."""
    plant = plant_cases.plant(LIFT, fast=fast)
    start = step.initial_state(plant, 0.6)
    start[V] = -0.02
    states, _ = plant_cases.run(plant, np.zeros(62_000), start=start)
    assert np.abs(states[:2000, V]).max() > 0.01
    assert abs(states[-1, X] - states[2000:12_000, X].mean()) < 1e-6 / 60


@pytest.mark.parametrize("mass_from_geometry", [False, True])
def test_energy_is_only_lost_and_exactly_to_friction(mass_from_geometry):
    table = load.knuckle_boom(with_mass=mass_from_geometry)
    plant = plant_cases.plant(LIFT, table=table, substep_count=40)
    prm = plant.parameters[0]
    start = step.initial_state(plant, 0.6)
    start[V] = 0.005 if mass_from_geometry else 0.02  # neither counterbalance valve may relieve
    states, _ = plant_cases.run(plant, np.zeros(3000), start=start)
    x, v = states[:, X], states[:, V]
    fine = np.linspace(x.min() - 1e-6, x.max() + 1e-6, 4001)
    coefficients = table.coefficients[7]  # the segment that holds 600 to 700 mm
    d = fine - 0.6
    force = coefficients[0] + d * (coefficients[1] + d * (coefficients[2] + d * coefficients[3]))
    below = table.coefficients[6]
    e = fine - 0.5
    force = np.where(fine < 0.6, below[0] + e * (below[1] + e * (below[2] + e * below[3])), force)
    potential = np.interp(x, fine, np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(fine))]))
    mass = prm["mass_kg"]
    if mass_from_geometry:
        mass = mass + np.where(
            x < 0.6, _cubic(table.coefficients[6, 4:], x - 0.5), _cubic(table.coefficients[7, 4:], x - 0.6)
        )
    stored = 0.5 * mass * v**2 + potential
    beta = prm["bulk_modulus_pa"]
    volume_1 = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * x
    volume_2 = prm["dead_volume_2_m3"] + prm["rod_side_area_m2"] * (prm["stroke_m"] - x)
    for volume, pressure in ((volume_1, states[:, P1]), (volume_2, states[:, P2])):
        # -integral p dV of trapped oil with p = p0 + beta ln(V0 / V)
        ratio = volume / volume[0]
        stored = stored - volume[0] * (pressure[0] * (ratio - 1) - beta * (ratio * np.log(ratio) - (ratio - 1)))
    amplitude = 0.5 * np.max(mass) * start[V] ** 2
    assert np.all(np.diff(stored) < 1e-4 * amplitude)
    lost = prm["viscous_friction_nspm"] * np.trapezoid(v**2, dx=1e-3)
    assert stored[0] - stored[-1] == pytest.approx(lost, rel=0.02, abs=1e-3 * amplitude)
    assert lost > 1e-3 * amplitude


def _cubic(c, d):
    return c[0] + d * (c[1] + d * (c[2] + d * c[3]))


@pytest.mark.parametrize("circuit", [LIFT, LINES])
def test_motion_follows_the_sign_of_the_command(circuit):
    plant = plant_cases.plant(circuit)
    for command in (0.1, 0.4, 1.0):
        up, _ = plant_cases.run(plant, np.full(1500, command))
        down, _ = plant_cases.run(plant, np.full(1500, -command))
        assert up[-1, V] > 0.001 and down[-1, V] < -0.001
    still, _ = plant_cases.run(plant, np.zeros(1500))
    assert np.abs(still[:, X] - 0.6).max() < 1e-9


def test_full_load_lowering_is_bounded_by_the_pump_not_by_the_load():
    """The counterbalance valve lets out only what the pump brings in on the other side: no runaway."""
    plant = plant_cases.plant(LIFT)
    prm = plant.parameters[0]
    bound = (
        prm["valve_pb_si"] * math.sqrt(prm["supply_pressure_pa"] - prm["tank_pressure_pa"]) / prm["rod_side_area_m2"]
    )
    states, _ = plant_cases.run(plant, np.full(8000, -1.0), position_m=1.0)
    settled = states[2000:]
    assert np.all(-settled[:, V] < bound) and np.all(-settled[:, V] > 0.9 * bound)
    assert settled[:, P2].min() > 0.3e6  # chamber 2 stays filled
    # without the valve (set to nothing, so it stands open) the load runs away and chamber 2 is torn empty
    open_valve = plant_cases.plant(LIFT, overrides={"setting_1_mpa": 0.1})
    start = step.initial_state(plant, 1.0)
    free, flags = plant_cases.run(open_valve, np.full(3000, -1.0), start=start)
    assert free[:, V].min() < -1.5 * bound and (flags & status.FLAG_CAVITATION).any()


@pytest.mark.parametrize("ratio", [1.5, 3.0, 4.5])
def test_pilot_ratio_sets_the_lowering_pressure_as_a_hand_calculation_says(ratio):
    """gamma p_B + p_1 = setting + k_c x / A_c, with x from the flow the rod pushes out; square-root orifices by hand."""
    plant = plant_cases.plant(LIFT, table=load.constant(7e5), overrides={"pilot_ratio": ratio})
    state = step.initial_state(plant, 0.8, -0.5)
    prm = plant.parameters[0]
    a1, a2 = 0.0804248, 0.0490088
    p_b = 1.2e6
    for _ in range(50):  # pump flow depends weakly on p_B
        speed = 0.25 * 4.057e-7 * math.sqrt(30e6 - p_b) / a2
        p_2 = p_b - 0.28e6  # check valve: crack 0.03, nearly open at 0.33 MPa
        p_1 = (7e5 + a2 * p_2 - 1000 * speed) / a1
        p_a = 0.2e6 + (a1 * speed / (4.5 * 0.5 * 4.057e-7)) ** 2
        opening = a1 * speed / (35.355e-7 * math.sqrt(p_1 - p_a))
        share = next(s for s in np.linspace(0, 1, 100_001) if s * s * (2 - s) >= opening)
        p_b = (12.5e6 + 23_940 * share * 4e-3 / 20e-6 - p_1) / ratio
    assert state[LINE_B] == pytest.approx(p_b, rel=0.01)
    assert state[V] == pytest.approx(-speed, rel=0.01)
    assert prm["pilot_ratio"] == ratio


def test_lowering_pressure_falls_with_the_pilot_ratio():
    pressure = [
        step.initial_state(plant_cases.plant(LIFT, overrides={"pilot_ratio": r}), 0.8, -0.5)[LINE_B]
        for r in (1.5, 3.0, 4.5, 9.0)
    ]
    assert all(a > b for a, b in zip(pressure, pressure[1:], strict=False))


@pytest.mark.parametrize("command", [1.0, -1.0, 0.3, -0.3])
def test_power_loss_with_the_valve_open_moves_nothing(command):
    """Pump at tank pressure: the pilots get nothing, both counterbalance valves stay shut."""
    whole = plant_cases.plant(LIFT)
    lost = plant_cases.plant(LIFT, overrides={"supply_pressure_mpa": 0.2000001})
    start = step.initial_state(whole, 0.6)
    states, _ = plant_cases.run(lost, np.full(20_000, command), start=start)
    assert np.abs(states[:, X] - 0.6).max() < 1e-8


def test_power_loss_in_full_motion_stops_the_load():
    whole = plant_cases.plant(LIFT)
    lost = plant_cases.plant(LIFT, overrides={"supply_pressure_mpa": 0.2000001})
    for command in (1.0, -1.0):
        moving = step.initial_state(whole, 0.6, command)
        states, _ = plant_cases.run(lost, np.full(5000, command), start=moving)
        assert abs(states[-1, X] - 0.6) < 5e-3
        assert abs(states[-1, X] - states[-2000, X]) < 1e-7


VACUUM_PA = -101_325.0


def torn(circuit, **fields):
    """A load that tears its cylinder apart, in a sea, under full reversals: chambers cavitate by a good part of their volume."""
    plant = plant_cases.plant(circuit, table=load.constant(-2.5e5), **fields)
    t = plant_cases.times(10.0)
    scales = 1.0 + 0.8 * np.sin(2 * np.pi * 1.0 * t) + 0.6 * np.sin(2 * np.pi * 2.3 * t)
    states, flags = plant_cases.run(plant, np.sign(np.sin(2 * np.pi * 0.4 * t)), scales)
    assert (flags & status.FLAG_CAVITATION).any() and np.isfinite(states).all()
    return plant, states


@pytest.mark.parametrize(
    ("circuit", "fields"), [(LIFT, {}), (LIFT, {"fast": True}), (LINES, {}), (PAPER, {}), (PAPER, {"fast": True})]
)
def test_no_pressure_is_below_absolute_vacuum(circuit, fields):
    _, states = torn(circuit, **fields)
    pressures = states[:, [P1, P2] + ([LINE_A, LINE_B] if circuit == LINES else [])]
    assert VACUUM_PA < pressures.min() < -0.08e6


def test_without_the_void_there_are_pressures_below_absolute_vacuum():
    """The plant of logs from before: else the test above says nothing."""
    _, states = torn(LIFT, overrides={"void_mpa": 0.0})
    assert states[:, [P1, P2]].min() < 1.1 * VACUUM_PA


def void_share(pressure_pa, prm):
    """Share of the oil's volume that is void: the integral of void_pa (1/a - 1/a_onset)^2 from a to the onset."""
    onset, a = prm["cavitation_pressure_pa"] - VACUUM_PA, pressure_pa - VACUUM_PA
    return prm["void_pa"] * (1 / a - 1 / onset - 2 / onset * np.log(onset / a) + (onset - a) / onset**2)


def test_a_void_is_filled_again_before_the_pressure_rises():
    """A shut chamber pulled apart by some centimetres and let back: void and oil together fill it at every moment."""
    plant = plant_cases.plant(PAPER, table=load.constant(-6e5), substep_count=200)
    prm = plant.parameters[0]
    start = step.initial_state(plant_cases.plant(PAPER, table=load.constant(0.0)), 0.6)
    t = plant_cases.times(1.5)
    scales = np.cos(2 * np.pi * t)  # pulls, pushes back, pulls
    states, _ = plant_cases.run(plant, np.zeros(len(t)), scales, start)
    pressure = states[:, P1]
    deep = pressure < prm["cavitation_pressure_pa"] - 0.02e6
    assert deep.any() and not deep.all() and VACUUM_PA < pressure.min()
    volume = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * states[:, X]
    grid = np.concatenate([np.linspace(VACUUM_PA + 1.0, -0.05e6, 200_001), np.linspace(-0.0499e6, 30e6, 200_001)])
    depth = (grid - prm["cavitation_pressure_pa"]) / prm["cavitation_width_pa"]
    ratio = prm["cavitation_ratio"]
    soft = prm["bulk_modulus_pa"] * (ratio + (1 - ratio) * 0.5 * (1 + np.tanh(depth)))
    logarithm = np.concatenate([[0.0], np.cumsum(np.diff(grid) * 0.5 * (1 / soft[1:] + 1 / soft[:-1]))])
    oil = volume * np.exp(
        np.interp(pressure, grid, logarithm) - np.where(pressure < -0.05e6, void_share(pressure, prm), 0.0)
    )
    assert np.ptp(oil) / oil[0] < 2e-4


@pytest.mark.parametrize(("from_m", "command", "end_m"), [(1.97, 1.0, 2.0), (0.03, -1.0, 0.0)])
def test_end_stops_absorb_a_full_speed_hit(from_m, command, end_m):
    plant = plant_cases.plant(LIFT)
    states, flags = plant_cases.run(plant, np.full(6000, command), position_m=from_m)
    into_stop = (states[:, X] - end_m) * command
    assert 1e-5 < into_stop.max() < 1e-3 and (flags & status.FLAG_END_STOP).any()
    assert states[-1, X] == pytest.approx(end_m, abs=1e-3) and abs(states[-1, V]) < 1e-4
    relief = plant.parameters[0]["relief_pressure_pa"]
    assert states[:, [P1, P2]].max() < relief * 1.1
    hit = np.flatnonzero(into_stop > 0)[0]
    after = states[hit:, X]
    assert (end_m - after).max() * command < 1e-3  # no bounce worth the name


def test_a_mirrored_actuator_moves_as_its_mirror_image():
    """Equal areas and edges, no load: command and its negative give the same motion to opposite sides."""
    equal = {
        "rod_side_area_mm2": 80424.8,
        "valve_pb_mm3ps_sqrtmpa": 4.057e5,
        "setting_2_mpa": 12.5,
        "rest_pressure_2_mpa": 2.0,
    }
    plant = plant_cases.plant(LIFT, table=load.constant(0.0), overrides=equal, substep_count=20)
    commands = 0.8 * np.sin(2 * np.pi * 0.7 * plant_cases.times(3.0))
    start = step.initial_state(plant, 1.0)
    one, _ = plant_cases.run(plant, commands, start=start)
    two, _ = plant_cases.run(plant, -commands, start=start)
    assert np.ptp(one[:, X]) > 2e-3
    assert np.abs((one[:, X] - 1.0) + (two[:, X] - 1.0)).max() < 1e-9
    assert np.abs(one[:, P1] - two[:, P2]).max() < 1.0
    assert np.abs(one[:, S1] - two[:, S2]).max() < 1e-9


def test_line_volumes_tend_to_algebraic_lines_as_they_shrink():
    commands = np.full(600, 0.6)
    exact, _ = plant_cases.run(plant_cases.plant(LIFT), commands)
    gaps = []
    for volume in (2e5, 2e4):
        over = {"line_volume_a_mm3": volume, "line_volume_b_mm3": volume}
        lines, _ = plant_cases.run(plant_cases.plant(LINES, overrides=over), commands)
        gaps.append(np.abs(lines - exact)[:, [P1, P2]].max())
    assert gaps[1] < 0.3 * gaps[0] < 1e4


def test_waves_move_the_held_load_elastically_only():
    plant = plant_cases.plant(LIFT)
    parts = wave.heave_components(0.5, 8.0, 1)
    scales = wave.load_scale_series(parts, plant_cases.times(30.0))
    start = step.initial_state(plant, 0.6, 0.0, scales[0])
    states, _ = plant_cases.run(plant, np.zeros(30_000), scales, start)
    # oil column: dx = dF / k, k = beta (A1^2/V1 + A2^2/V2)
    prm = plant.parameters[0]
    volume_1 = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * 0.6
    volume_2 = prm["dead_volume_2_m3"] + prm["rod_side_area_m2"] * 1.4
    stiffness = prm["bulk_modulus_pa"] * (prm["bore_area_m2"] ** 2 / volume_1 + prm["rod_side_area_m2"] ** 2 / volume_2)
    expected = np.ptp(scales) * 703_880 / stiffness
    assert np.ptp(states[:, X]) == pytest.approx(expected, rel=0.05)


def test_article_preset_and_mass_free_reduction_agree_where_the_spool_rides_its_stop():
    plant = plant_cases.plant(PAPER)
    commands = np.concatenate([np.full(500, 0.5), np.full(500, 1.0)])
    full, _ = plant_cases.run(plant, commands)
    reduced, _ = plant_cases.run(replace(plant, fast=True, substep_count=14), commands)
    assert np.abs(full - reduced)[:, [P1, P2]].max() < 10.0  # 1e-5 MPa
    assert parameters.PRESETS["paper"]["pilot_ratio"] == 4.5
