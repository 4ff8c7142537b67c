"""Loads: the crane's geometry against the table it was restored from, the interpolation against scipy."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from hilrunner.base.compiled import entry
from hilrunner.base.errors import ProfileError
from hilrunner.plant import load

# rod position mm: force kN, equivalent mass t, rise of the tip per rod travel (docs/paper.md, load)
TABLE = {
    0: (649.99, 417, 7.51),
    500: (696.52, 493, 8.17),
    1000: (724.32, 572, 8.65),
    1200: (727.29, 606, 8.76),
    1600: (708.59, 685, 8.74),
    2000: (616.59, 832, 8.02),
}


@entry
def _evaluate(loads, x, out):
    for i in range(len(x)):
        out[i, 0], out[i, 1], out[i, 2] = load.load_force_and_mass(loads[0], x[i])
        out[i, 3] = load.load_force_n(loads[0], x[i])


def evaluate(table, x):
    out = np.empty((len(x), 4))
    _evaluate(table.record(), np.asarray(x, dtype=float), out)
    return out


@pytest.mark.parametrize("x_mm", TABLE)
def test_crane_geometry(x_mm):
    force_kn, mass_t, rise = TABLE[x_mm]
    crane = load.Crane()
    x = x_mm * 1e-3
    assert load.crane_force_n(crane, x) / 1e3 == pytest.approx(force_kn, abs=0.006)
    assert load.crane_mass_kg(crane, x) / 1e3 == pytest.approx(mass_t, abs=0.5)
    assert load.tip_ratio(crane, x) == pytest.approx(rise, abs=0.006)


def test_force_is_the_derivative_of_the_potential_energy():
    crane = load.Crane()
    h = 1e-6

    def potential(x):
        theta, _ = load.boom_geometry(crane, x)
        jib = theta - crane.jib_angle_rad
        boom_tip = crane.boom_length_m * np.sin(theta)
        heights = (
            crane.boom_mass_kg * crane.boom_centre_share * boom_tip,
            crane.knuckle_cylinder_mass_kg * crane.knuckle_cylinder_share * boom_tip,
            crane.jib_mass_kg * (boom_tip + crane.jib_centre_share * crane.jib_length_m * np.sin(jib)),
            crane.payload_kg * (boom_tip + crane.jib_length_m * np.sin(jib)),
        )
        return load.GRAVITY_MPS2 * sum(heights)

    for x in (0.1, 0.9, 1.7):
        slope = (potential(x + h) - potential(x - h)) / (2 * h)
        assert load.crane_force_n(crane, x) == pytest.approx(slope, rel=1e-7)


def test_knots_interpolate_the_formula_as_stated():
    x = np.linspace(0, 2, 4001)
    exact = load.crane_force_n(load.Crane(), x)
    assert np.max(np.abs(evaluate(load.knuckle_boom(), x)[:, 0] / exact - 1)) == pytest.approx(3.4e-4, rel=0.1)


@pytest.mark.parametrize("count", [2, 3, 4, 21, load.KNOT_LIMIT])
@pytest.mark.parametrize("uniform", [True, False])
def test_interpolation_is_scipys_pchip(count, uniform):
    generator = np.random.default_rng(count)
    x = np.linspace(0.1, 1.9, count) if uniform else np.cumsum(generator.uniform(0.01, 0.2, count))
    y = generator.normal(0, 1e5, count)
    y[generator.random(count) < 0.2] = 3e4
    table = load.from_table(x, y, np.abs(y))
    assert (table.inverse_spacing_pm > 0) == (uniform or count == 2)
    query = np.sort(np.concatenate([generator.uniform(x[0], x[-1], 500), x]))
    out = evaluate(table, query)
    assert np.allclose(out[:, 0], PchipInterpolator(x, y)(query), rtol=0, atol=1e-6)
    mass = PchipInterpolator(x, np.abs(y))
    assert np.allclose(out[:, 1], mass(query), rtol=0, atol=1e-6)
    assert np.allclose(out[:, 2], mass.derivative()(query), rtol=1e-9, atol=1e-3)
    assert np.array_equal(out[:, 0], out[:, 3])


def test_linear_outside_the_knots():
    table = load.knuckle_boom(with_mass=True)
    out = evaluate(table, [-0.2, -0.1, 0.0, 2.0, 2.1, 2.2])
    assert out[1, 0] - out[0, 0] == pytest.approx(out[2, 0] - out[1, 0], rel=1e-9)
    assert out[4, 0] - out[3, 0] == pytest.approx(out[5, 0] - out[4, 0], rel=1e-9)
    inside = evaluate(table, [1e-7, 2.0 - 1e-7])
    assert inside[0, 0] == pytest.approx(out[2, 0], rel=1e-7)
    assert inside[1, 0] == pytest.approx(out[3, 0], rel=1e-7)


def test_a_position_that_is_no_number_reads_no_foreign_memory():
    out = evaluate(load.knuckle_boom(), [np.nan, np.inf, -np.inf, 1e300])
    assert np.isnan(out[0, 0])


def test_perturbed_load_is_reproducible_and_as_stated():
    forces = load.perturbed(load.knuckle_boom(), 0.02, 5).force_n / 1e3
    assert np.allclose(forces[[0, 9, 13, 19]], [639.56, 744.36, 749.50, 645.93], atol=0.006)
    assert np.array_equal(forces, load.perturbed(load.knuckle_boom(), 0.02, 5).force_n / 1e3)
    assert not np.array_equal(forces, load.perturbed(load.knuckle_boom(), 0.02, 6).force_n / 1e3)
    heavy = load.knuckle_boom(with_mass=True)
    assert np.array_equal(load.perturbed(heavy, 0.02, 5).mass_kg, heavy.mass_kg)


@pytest.mark.parametrize(
    ("x", "force", "mass", "named"),
    [
        ([0.0], [1.0], None, "at least 2 knots"),
        ([0.0, 1.0], [1.0], None, "equal lengths"),
        ([0.0, 1.0, 1.0], [1.0, 2.0, 3.0], None, "increase"),
        ([0.0, 1.0], [1.0, np.nan], None, "not finite"),
        ([0.0, 1.0], [1.0, 2.0], [1.0, -2.0], "negative equivalent mass -2 kg"),
        (np.arange(load.KNOT_LIMIT + 1), np.zeros(load.KNOT_LIMIT + 1), None, f"at most {load.KNOT_LIMIT}"),
    ],
)
def test_bad_tables_are_refused(x, force, mass, named):
    with pytest.raises(ProfileError, match=named):
        load.from_table(x, force, mass)


def test_bad_perturbation_is_refused():
    with pytest.raises(ProfileError, match="0 to 1"):
        load.perturbed(load.knuckle_boom(), -0.1, 1)
