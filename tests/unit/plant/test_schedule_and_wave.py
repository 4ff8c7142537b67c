"""Valve schedules and sea states: values, reproducibility, refusals."""

import numpy as np
import pytest

from hilrunner.base.errors import ProfileError
from hilrunner.plant import schedule, wave


def test_lift_profile_visits_its_plateaus():
    t = np.array([0.0, 2.0, 7.0, 10.0, 13.0, 15.5, 18.0, 19.9])
    expected = [0.0, 0.5, 1.0, 0.3, 0.8, 0.0, 0.6, 0.0]
    for name in ("lift-profile", "lift-profile-2ms"):
        assert schedule.sample(schedule.SCHEDULES[name], t) == pytest.approx(expected, abs=1e-12)


def test_smooth_ramps_are_twice_differentiable_and_steps_are_steps():
    t = np.arange(0.4, 0.9, 1e-4)
    u = schedule.sample(schedule.Ramps(1.0, ((0.5, 0.3, 0.5),)), t)
    assert np.abs(np.diff(u, 2)).max() < 0.5 * 5.78 / 0.09 * 1e-8 * 1.01
    u = schedule.sample(schedule.Ramps(1.0, ((0.5, 0.0, 0.5),)), np.array([0.4999999, 0.5]))
    assert u.tolist() == [0.0, 0.5]


@pytest.mark.parametrize("name", schedule.SCHEDULES)
def test_shipped_schedules_stay_in_range_and_repeat(name):
    data = schedule.SCHEDULES[name]
    t = np.arange(0, data.duration_s, 1e-2)
    u = schedule.sample(data, t)
    assert np.all(np.abs(u) <= 1.0) and np.array_equal(u, schedule.sample(data, t))
    assert (np.ptp(u) == 0.0) == (name == "hold")


def test_chirp_reaches_its_frequencies():
    data = schedule.SCHEDULES["chirp"]
    t = np.arange(0, data.duration_s, 1e-4)
    crossings = t[1:][np.diff(np.sign(schedule.sample(data, t))) != 0]
    assert 0.5 / np.diff(crossings)[0] == pytest.approx(data.start_hz, rel=0.6)
    assert 0.5 / np.diff(crossings)[-1] == pytest.approx(data.end_hz, rel=0.05)


def test_random_steps_hold_for_their_dwell_and_follow_their_seed():
    data = schedule.RandomSteps(20.0, 0.25, -0.5, 0.6, seed=4)
    u = schedule.sample(data, np.arange(0, 20, 1e-2))
    assert set(u.tolist()) == {-0.5, 0.6}
    assert np.all(u.reshape(-1, 25) == u.reshape(-1, 25)[:, :1])
    other = schedule.RandomSteps(20.0, 0.25, -0.5, 0.6, seed=5)
    assert not np.array_equal(u, schedule.sample(other, np.arange(0, 20, 1e-2)))


@pytest.mark.parametrize(("height", "period", "std", "speed"), [(0.5, 6, 0.053, 0.204), (2.0, 8, 0.306, 0.858)])
def test_sea_states_have_the_heave_they_should(height, period, std, speed):
    w = np.linspace(0.1, 30, 300_000)
    assert 4 * np.sqrt(np.trapezoid(wave.jonswap_m2s(w, height, period), w)) == pytest.approx(height, rel=4e-3)
    series = wave.heave_series(wave.heave_components(height, period, 1), np.arange(0, 3600, 0.1))
    assert series[:, 0].std() == pytest.approx(std, rel=0.05)
    assert np.abs(series[:, 1]).max() == pytest.approx(speed, rel=0.12)


def test_heave_speed_and_acceleration_are_its_derivatives():
    parts = wave.heave_components(1.0, 7.0, 2)
    t = np.linspace(0, 60, 60_001)
    series = wave.heave_series(parts, t)
    assert np.allclose(np.gradient(series[:, 0], t)[1:-1], series[1:-1, 1], atol=1e-6)
    assert np.allclose(np.gradient(series[:, 1], t)[1:-1], series[1:-1, 2], atol=1e-6)
    assert np.allclose(wave.load_scale_series(parts, t), 1 + series[:, 2] / 9.81, rtol=1e-14)


def test_waves_follow_their_seed_and_never_repeat_within_an_hour():
    one, same, other = (wave.heave_components(1.0, 7.0, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)
    first = wave.heave_series(one, np.arange(0, 60, 0.5))[:, 0]
    for shift in range(60, 3600, 60):
        later = wave.heave_series(one, np.arange(shift, shift + 60, 0.5))[:, 0]
        assert np.abs(later - first).max() > 1e-3


def test_calm_sea_loads_nothing():
    assert np.all(wave.load_scale_series(wave.no_heave(), np.arange(10.0)) == 1.0)


@pytest.mark.parametrize(("height", "period"), [(0.0, 8.0), (-1.0, 8.0), (21.0, 8.0), (1.0, 1.0), (1.0, np.nan)])
def test_impossible_seas_are_refused(height, period):
    with pytest.raises(ProfileError, match="wave"):
        wave.heave_components(height, period, 1)
