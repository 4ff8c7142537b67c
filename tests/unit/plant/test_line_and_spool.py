"""The line solve and the mass-free spool against bisection and their own balances."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base.compiled import entry
from hilrunner.plant import line, parameters, spool

PRM = parameters.make_parameters("lift")


@entry
def _solve(prm, chamber, cbv, supply, drain, guess):
    return line.solve_line(prm[0], chamber, cbv, supply, drain, guess)


@entry
def _balance(prm, at, chamber, cbv, supply, drain):
    return line.line_balance(prm[0], at, chamber, cbv, supply, drain)


@entry
def _slopes(prm, at, chamber, cbv, supply, drain, out):
    out[0], out[1] = line.valve_side_flow(prm[0], at, supply, drain)
    out[2], out[3] = line.chamber_side_flow(prm[0], at, chamber, cbv)


@entry
def _conductances(prm, command):
    return line.valve_conductances(prm[0], command)


@entry
def _spool_speed(prm, force, position):
    return spool.mass_free_spool_speed(prm[0], force, position)


@entry
def _spool_acceleration(prm, force, position, speed):
    return spool.spool_acceleration(prm[0], force, position, speed)


pressures = st.floats(-1e5, 33e6)
conductances = st.one_of(st.just(0.0), st.floats(-16, -5).map(lambda power: 10.0**power))
positive = st.floats(-9, -5).map(lambda power: 10.0**power)


@settings(max_examples=600, deadline=None, derandomize=True)
@given(pressures, conductances, conductances, conductances, st.floats(-1e9, 1e9), positive, st.booleans())
def test_line_solve_ends_at_the_root_from_any_guess(chamber, cbv, supply, drain, guess, edge, pump):
    supply, drain = (edge, drain) if pump else (supply, edge)  # one edge is open, as the valve guarantees
    found, flow, iterations, follow = _solve(PRM, chamber, cbv, supply, drain, guess)
    assert iterations <= line.ITERATION_LIMIT
    prm = PRM[0]
    low = min(prm["tank_pressure_pa"], chamber)
    high = max(prm["supply_pressure_pa"], chamber)
    assert low - 1.0 <= found <= high + 1.0
    assert 0.0 <= follow <= 1.0
    # the balance changes sign around what was found, within what one step to first order leaves
    reach = 1.0
    below = _balance(PRM, found - reach, chamber, cbv, supply, drain)
    above = _balance(PRM, found + reach, chamber, cbv, supply, drain)
    assert below >= -1e-30 and above <= 1e-30
    # the flow is what the chamber side passes there
    passed = np.empty(4)
    _slopes(PRM, found, chamber, cbv, supply, drain, passed)
    assert flow == pytest.approx(passed[2], rel=1e-4, abs=passed[3] * reach + 1e-18)


def test_line_solve_agrees_with_bisection_to_a_fiftieth_of_a_pascal():
    generator = np.random.default_rng(3)
    worst, counts = 0.0, []
    for _ in range(300):
        chamber = generator.uniform(0.3e6, 15e6)
        cbv, edge = 10.0 ** generator.uniform(-9, -5.5), 10.0 ** generator.uniform(-8, -6)
        supply, drain = (edge, 0.0) if generator.random() < 0.5 else (0.0, edge)
        low, high = 0.0, 31e6
        for _ in range(100):
            middle = 0.5 * (low + high)
            if _balance(PRM, middle, chamber, cbv, supply, drain) > 0:
                low = middle
            else:
                high = middle
        guess = 0.5 * (low + high) + generator.uniform(-500, 500)
        found, _, iterations, _ = _solve(PRM, chamber, cbv, supply, drain, guess)
        worst = max(worst, abs(found - 0.5 * (low + high)))
        counts.append(iterations)
    assert worst < 0.02
    assert np.mean(counts) < 2.5 and max(counts) < 25


def test_a_shut_return_line_passes_exactly_nothing():
    tank = PRM["tank_pressure_pa"][0]
    for chamber in (tank, 1e6, 12e6):
        assert _solve(PRM, chamber, 0.0, 0.0, 1e-7, 5e6) == (tank, 0.0, 0, 0.0)


def test_the_line_follows_its_chamber_as_told():
    for chamber, cbv, supply, drain in ((9e6, 0.0, 2e-7, 0.0), (6e5, 3e-6, 0.0, 1e-6), (9e6, 1e-7, 1e-8, 5e-8)):
        at, _, _, follow = _solve(PRM, chamber, cbv, supply, drain, chamber)
        up, _, _, _ = _solve(PRM, chamber + 200.0, cbv, supply, drain, at + 200.0 * follow)
        assert (up - at) / 200.0 == pytest.approx(follow, abs=2e-3)


def test_no_number_ends_too():
    for values in ((math.nan, 1e-7, 1e-7, 0.0), (1e6, math.nan, 1e-7, 0.0), (1e6, 1e-7, math.nan, 0.0)):
        found, _, iterations, _ = _solve(PRM, *values, 1e6)
        assert iterations <= line.ITERATION_LIMIT + 1
        assert math.isnan(found) or math.isfinite(found)


def test_slopes_are_derivatives_over_every_term():
    # relief open; anti-cavitation half open; check half open; plain
    cases = ((33e6, 9e6, 1e-7, 2e-7, 1e-7), (0.155e6, 1e6, 1e-7, 1e-8, 1e-7), (1.18e6, 1e6, 1e-7, 2e-7, 0.0))
    for at, chamber, cbv, supply, drain in cases:
        here, up, down = np.empty(4), np.empty(4), np.empty(4)
        _slopes(PRM, at, chamber, cbv, supply, drain, here)
        _slopes(PRM, at + 1.0, chamber, cbv, supply, drain, up)
        _slopes(PRM, at - 1.0, chamber, cbv, supply, drain, down)
        assert here[1] == pytest.approx((up[0] - down[0]) / 2, rel=1e-6)
        assert here[3] == pytest.approx((up[2] - down[2]) / 2, rel=1e-6)


def test_valve_opens_the_right_edges():
    prm = PRM[0]
    assert _conductances(PRM, 0.0) == (0.0, prm["bleed_si"], 0.0, prm["bleed_si"])
    assert _conductances(PRM, 0.5) == (0.5 * prm["valve_pa_si"], 0.0, 0.0, 0.5 * prm["valve_bt_si"])
    assert _conductances(PRM, -1.0) == (0.0, prm["valve_at_si"], prm["valve_pb_si"], 0.0)
    for command in np.linspace(-1, 1, 401):
        pa, at, pb, bt = _conductances(PRM, command)
        assert pa + at > 0 and pb + bt > 0 and pa * pb == 0.0  # a line is never cut off from both pump and tank


@settings(max_examples=400, deadline=None, derandomize=True)
@given(st.floats(-900, 900), st.floats(-0.8e-3, 4.8e-3))
def test_mass_free_spool_speed_balances_the_force(force, position):
    speed = _spool_speed(PRM, force, position)
    remainder = _spool_acceleration(PRM, force, position, speed) * PRM["spool_mass_kg"][0]
    scale = 1.0 + abs(force) + 1e6 * max(0.0, -position, position - 4e-3)
    assert abs(remainder) < 1e-9 * scale


def test_mass_free_spool_rests_only_in_balance():
    assert _spool_speed(PRM, 0.0, 0.0) == 0.0
    assert _spool_speed(PRM, PRM["spool_spring_npm"][0] * 2e-3, 2e-3) == pytest.approx(0.0, abs=1e-15)
    assert _spool_speed(PRM, 10.0, 0.0) > 0 > _spool_speed(PRM, -10.0, 2e-3)
