"""The article's inconsistencies as numbers; docs/paper.md has a line for each. Units of the article: mm, N, MPa, s."""

import numpy as np
import pytest

A1, A2 = 80424.8, 49008.8  # Table 1
K_Q, K_QC = 4.057e5, 35.355e5
SUPPLY, BULK = 30.0, 690.0


def parameter_count(*layers):
    return sum(rows * columns + rows for columns, rows in zip(layers, layers[1:], strict=False))


def steady_lift(load_n, return_factor):
    """(p1, p2, speed mm/s) at u = 1: flow in = A1 v, flow out = A2 v through return edge and fully open valve in series."""
    p1 = load_n / A1
    for _ in range(200):
        speed = K_Q * np.sqrt(SUPPLY - p1) / A1
        p2 = (A2 * speed / (return_factor * K_Q)) ** 2 + (A2 * speed / K_QC) ** 2
        p1 = (load_n + A2 * p2) / A1
    return p1, p2, speed


def test_the_line_pressure_has_a_closed_form():
    rng = np.random.default_rng(1)
    u, opening, p2 = rng.uniform(0.01, 1, 1000), rng.uniform(0.01, 1, 1000), rng.uniform(0.01, 20, 1000)
    k_t, k_c = K_Q * u, K_QC * opening
    p_r = k_c**2 / (k_c**2 + k_t**2) * p2
    residual = k_t**2 * p_r - k_c**2 * (p2 - p_r)  # Eq. (5)
    assert np.abs(residual / (k_c**2 * p2)).max() < 1e-14


@pytest.mark.parametrize("load_kn", [603.0, 650.0, 727.0, 764.0])
def test_table_1_leaves_the_box_of_table_2(load_kn):
    _, p2_printed, _ = steady_lift(load_kn * 1e3, 1.0)
    p1, p2, speed = steady_lift(load_kn * 1e3, 4.5)
    assert 6.2 < p2_printed < 7.0, "Table 2 has p2 in -1..1"
    assert 0.45 < p2 < 0.55 and p1 < 9.9
    assert 22.0 < speed < 24.5, "Table 2 has speeds of +-1000 mm/s"
    assert pytest.approx(4825, rel=1e-3) == A1 * 1000.0 * 60e-6, "L/min that 1000 mm/s would need"


def test_a_dead_volume_of_20_mm3_is_no_length_at_all():
    assert pytest.approx(2.5e-4, rel=0.01) == 20.0 / A1, "mm of stroke"
    stiffness = BULK * A1**2 / 20.0 + BULK * A2**2 / (20.0 + A2 * 2000.0)  # N/mm at x = 0
    rate = np.sqrt(stiffness / 0.2)  # 1/s, mass 0.2 t
    assert 2.83 / rate < 5e-6, "s, RK4's limit on the imaginary axis"
    proposed = BULK * A1**2 / 1e6 + BULK * A2**2 / (1e6 + A2 * 2000.0)
    assert 2.83 / np.sqrt(proposed / 0.2) > 500e-6


def test_the_network_has_672_parameters():
    assert parameter_count(5, 25, 10, 20, 2) == 672
    assert parameter_count(4, 25, 10, 20, 2) == 647
    assert sum(width * (4 + 2) + 1 for width in (25, 10, 20)) == 333


def constant_predictor_errors(sample_count, seed, block=1_000_000):
    """Normalised mean square errors of the two mean pressure rates over Table 2's box, dead volumes as printed.

    Latin hypercube in x, which alone makes the extremes; the other variables are independent.
    """
    random = np.random.default_rng(seed)
    total, squares, low, high = np.zeros(2), np.zeros(2), np.full(2, np.inf), np.full(2, -np.inf)
    for first in range(0, sample_count, block):
        x = (np.arange(first, first + block) + random.random(block)) / sample_count * 2000.0
        v, p1, p2, u = (random.uniform(*limits, block) for limits in ((-1e3, 1e3), (7.5, 9.5), (-1.0, 1.0), (0.0, 1.0)))
        series = K_QC * K_Q * u / np.hypot(K_QC, K_Q * u)
        rates = np.array(
            [
                BULK / (20.0 + A1 * x) * (K_Q * u * np.sqrt(SUPPLY - p1) - A1 * v),
                BULK / (20.0 + A2 * (2000.0 - x)) * (A2 * v - series * np.sign(p2) * np.sqrt(np.abs(p2))),
            ]
        )
        total, squares = total + rates.sum(axis=1), squares + (rates**2).sum(axis=1)
        low, high = np.minimum(low, rates.min(axis=1)), np.maximum(high, rates.max(axis=1))
    variance = squares / sample_count - (total / sample_count) ** 2
    return variance / ((high - low) / 2.0) ** 2


def test_a_constant_has_the_published_order_of_normalised_error():
    """Targets scaled to [-1, 1]: the more samples, the more extreme the extremes, the 'better' the mean alone."""
    few, many = constant_predictor_errors(400_000, 2, 400_000), constant_predictor_errors(25_000_000, 2)
    assert many == pytest.approx([1.9e-7, 2.3e-7], rel=0.05)  # 1.4e-7 to 4.1e-7 by seed
    assert np.all(few > 10.0 * many)
    # with ever more samples: E[1/V^2] = 1/(V_d (V_d + A L)) times the spread of A v, over the square of the rate at V_d
    for area, flow in ((A1, K_Q * np.sqrt(SUPPLY - 7.5)), (A2, K_Q)):
        spread = (area * 1000.0) ** 2 / 3.0 / (20.0 * (20.0 + area * 2000.0))
        limit = spread / ((area * 1000.0 + flow / 2.0) / 20.0) ** 2
        assert 3e-8 < limit < 7e-8
