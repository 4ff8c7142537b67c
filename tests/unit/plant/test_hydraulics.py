"""Hydraulic elements against closed forms, the standard library and finite differences."""

import math

import numpy as np
import pytest

from hilrunner.base.compiled import entry
from hilrunner.plant import hydraulics

P_TR = 1e4


@entry
def _roots(drops, transition, out):
    for i in range(len(drops)):
        out[i, 0], out[i, 1] = hydraulics.orifice_root_and_slope(drops[i], transition)
        out[i, 2] = hydraulics.orifice_root(drops[i], transition)
        out[i, 3] = hydraulics.inverse_orifice_root(out[i, 2], transition)


@entry
def _signs(ratios, out):
    for i in range(len(ratios)):
        out[i] = hydraulics.smooth_sign(ratios[i])


@entry
def _small(shares, out):
    for i in range(len(shares)):
        s = shares[i]
        out[i, 0] = hydraulics.smoothstep(s)
        out[i, 1] = hydraulics.smoothstep_slope(s)
        out[i, 2] = hydraulics.opening_ratio(s * 4e-3, 4e-3)
        out[i, 3] = hydraulics.softened_bulk_modulus(s * 1e6, 690e6, -5e4, 2e4, 1e-3)


@entry
def _stops(positions, velocities, out):
    for i in range(len(positions)):
        out[i] = hydraulics.two_sided_stop_force(positions[i], velocities[i], 2.0, 2e9, 5.0)


def roots(drops):
    out = np.empty((len(drops), 4))
    _roots(np.asarray(drops, dtype=float), P_TR, out)
    return out


@pytest.mark.parametrize(("drop_mpa", "error"), [(0.1, -2.5e-3), (0.4, -1.6e-4), (1.0, -2.5e-5)])
def test_orifice_differs_from_the_square_root_as_stated(drop_mpa, error):
    drop = drop_mpa * 1e6
    assert roots([drop])[0, 0] / math.sqrt(drop) - 1.0 == pytest.approx(error, rel=0.03)


def test_orifice_is_odd_increasing_and_linear_through_zero():
    drops = np.concatenate([-np.geomspace(1e8, 1e-6, 60), [0.0], np.geomspace(1e-6, 1e8, 60)])
    value = roots(drops)[:, 0]
    assert np.all(np.diff(value) > 0)
    assert np.allclose(value, -value[::-1], rtol=1e-15)
    assert value[60] == 0.0
    assert roots([1e-3])[0, 0] == pytest.approx(1e-3 / math.sqrt(P_TR), rel=1e-12)


def test_orifice_slope_is_its_derivative():
    drops = np.array([-3e6, -2e4, -10.0, 0.0, 5e3, 1e5, 2e7])
    h = 1e-4 * (np.abs(drops) + P_TR)
    difference = (roots(drops + h)[:, 0] - roots(drops - h)[:, 0]) / (2 * h)
    assert np.allclose(roots(drops)[:, 1], difference, rtol=1e-6)


def test_orifice_inverse_undoes_it():
    drops = np.concatenate([-np.geomspace(1e8, 1.0, 40), np.geomspace(1.0, 1e8, 40)])
    assert np.allclose(roots(drops)[:, 3], drops, rtol=1e-9)


def test_both_orifice_functions_agree():
    out = roots(np.linspace(-3e7, 3e7, 101))
    assert np.allclose(out[:, 0], out[:, 2], rtol=4e-16 * 4)


def test_smooth_sign_is_tanh_to_rounding():
    size = np.concatenate([np.geomspace(1e-300, 0.05, 500), np.linspace(0.02, 0.04, 200), np.linspace(0.05, 25, 2000)])
    ratios = np.concatenate([-size, [0.0, -0.0], size, [1e300, -1e300]])
    out = np.empty_like(ratios)
    _signs(ratios, out)
    exact = np.array([math.tanh(r) for r in ratios])
    assert np.max(np.abs(out - exact)) <= 3e-16
    assert np.all(np.abs(out) <= 1.0)


def test_smoothstep_and_opening_are_monotone_with_flat_or_given_ends():
    shares = np.linspace(-0.5, 1.5, 2001)
    out = np.empty((len(shares), 4))
    _small(shares, out)
    inside = (shares > 0) & (shares < 1)
    assert np.all(out[shares <= 0, :3] == 0.0)
    assert np.all(out[shares >= 1, 0] == 1.0) and np.all(out[shares >= 1, 2] == 1.0)
    assert np.all(np.diff(out[inside, 0]) > 0) and np.all(np.diff(out[inside, 2]) > 0)
    slope = np.gradient(out[:, 0], shares)
    assert np.allclose(slope[inside][1:-1], out[inside, 1][1:-1], atol=5e-3)


def test_bulk_modulus_is_whole_under_pressure_half_at_the_threshold_and_almost_none_in_vacuum():
    out = np.empty((3, 4))
    _small(np.array([1.0, -0.05, -0.5]), out)
    assert out[0, 3] == 690e6
    assert out[1, 3] == pytest.approx(690e6 * (1e-3 + 0.999 * 0.5), rel=1e-12)
    assert out[2, 3] == pytest.approx(690e3, rel=1e-12)


def test_bulk_modulus_softens_by_seven_tenths_of_a_percent_at_zero_gauge():
    out = np.empty((1, 4))
    _small(np.array([0.0]), out)
    assert 1.0 - out[0, 3] / 690e6 == pytest.approx(0.0067, abs=2e-4)


@entry
def _voids(pressures, soft, onset, void, out):
    for i in range(len(pressures)):
        out[i] = hydraulics.bulk_modulus_of_void(pressures[i], soft, onset, void)


def test_a_void_adds_its_compliance_to_the_oils():
    onset, void, soft = -0.05e6, 100.0, 5e6
    above = np.geomspace(5.0, 51_324.0, 200)
    out = np.empty(len(above))
    _voids(hydraulics.ABSOLUTE_VACUUM_PA + above, soft, onset, void, out)
    of_void = 1 / out - 1 / soft
    assert np.allclose(
        of_void, void * (1 / above - 1 / (onset - hydraulics.ABSOLUTE_VACUUM_PA)) ** 2, rtol=1e-6, atol=1e-16
    )
    assert np.all(np.diff(out) > 0.0)
    assert out[0] == pytest.approx(above[0] ** 2 / void, rel=1e-3)  # Boyle: the volume of a constant amount of gas
    assert out[-1] == pytest.approx(soft, rel=1e-6)  # begins without a step


def test_stops_push_and_never_pull():
    positions = np.array([-1e-4, -1e-4, -1e-4, 1.0, 2.0001, 2.0001, 2.0001])
    velocities = np.array([0.0, -0.1, 5.0, 0.0, 0.0, 0.1, -5.0])
    out = np.empty(len(positions))
    _stops(positions, velocities, out)
    assert out[0] == pytest.approx(2e5)
    assert out[1] == pytest.approx(2e5 * 1.5)
    assert out[2] == 0.0  # leaving faster than the stop follows
    assert out[3] == 0.0
    assert out[4] == pytest.approx(-2e5, rel=1e-6)
    assert out[5] == pytest.approx(-3e5, rel=1e-6)
    assert out[6] == 0.0
