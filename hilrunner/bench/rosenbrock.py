"""A rival for the plant's RK4: a linearly implicit method of order four with fixed steps, compiled on the same right-hand side.

Kaps and Rentrop's four-stage Rosenbrock method with Shampine's coefficients (P. Kaps, P. Rentrop, Numer. Math. 33, 1979;
L. F. Shampine, ACM TOMS 8, 1982): A-stable, no Newton iteration. One Jacobian a step by forward differences, one LU
decomposition, three evaluations. It lives in the bench only: it exists to be compared with. In `lift` every evaluation solves
the line pressures to the end, while RK4 carries its guess from stage to stage: `paper` and `lift-lines` compare the methods alone.
"""

import numpy as np

from hilrunner.base.compiled import entry, hot
from hilrunner.bench.plant_cases import PERIOD_S
from hilrunner.plant.stability import active_places, state_rates
from hilrunner.plant.step import AxisPlant

_GAMMA = 0.5
_A = ((2.0, 0.0), (48.0 / 25.0, 6.0 / 25.0))  # of the second and third point; the fourth stage takes the third's rates
_C = ((-8.0, 0.0, 0.0), (372.0 / 25.0, 12.0 / 5.0, 0.0), (-112.0 / 125.0, -54.0 / 125.0, -2.0 / 5.0))
_B = (19.0 / 9.0, 0.5, 25.0 / 108.0, 125.0 / 108.0)
_DIFFERENCE = np.array([1e-7, 1e-6, 1.0, 1.0, 1e-8, 1e-8, 1e-6, 1e-6, 1.0, 1.0])  # SI, by place of base.state_layout


class Rosenbrock:
    """All periods of one first-principle plant with `count` Rosenbrock steps each; call it for the states, float64[n, 10]."""

    def __init__(self, plant: AxisPlant, held: np.ndarray, start: np.ndarray, count: int) -> None:
        self._plant, self._held, self._start, self._count = plant, held, start, count
        self._places = np.array(active_places(plant.circuit, plant.fast))
        self._load = plant.load.record()

    def __call__(self) -> np.ndarray:
        states = np.zeros((len(self._held), 10))
        plant = self._plant
        _run(
            plant.parameters, self._load, plant.circuit, plant.fast, self._held, PERIOD_S, self._count,
            self._places, _DIFFERENCE, self._start.copy(), states,
        )  # fmt: skip
        return states


@entry
def _run(parameters, loads, circuit, fast, held, period_s, count, places, difference, start, states_out):
    """Every period; `start` (10,) is written, derived places keep their start."""
    n = places.shape[0]
    at, rates = np.zeros((1, 10)), np.zeros((1, 10))
    matrix, inverse_pivot, k = np.zeros((n, n)), np.zeros(n), np.zeros((4, n))
    f0, pivot = np.zeros(n), np.zeros(n, np.int64)
    for i in range(held.shape[0]):
        for _ in range(count):
            _step(
                parameters, loads, circuit, fast, held[i], period_s / count, places, difference, start,
                at, rates, matrix, inverse_pivot, pivot, f0, k,
            )  # fmt: skip
        for place in range(10):
            states_out[i, place] = start[place]


@hot
def _step(
    parameters, loads, circuit, fast, valve, h, places, difference, y, at, rates, matrix, inverse_pivot, pivot, f0, k
):
    n = places.shape[0]
    at[0, :] = y
    state_rates(parameters, loads, 1.0, circuit, fast, valve, at, rates)
    for row in range(n):
        f0[row] = rates[0, places[row]]
    for column in range(n):
        place = places[column]
        at[0, place] = y[place] + difference[place]
        state_rates(parameters, loads, 1.0, circuit, fast, valve, at, rates)
        at[0, place] = y[place]
        for row in range(n):
            matrix[row, column] = -(rates[0, places[row]] - f0[row]) / difference[place]
        matrix[column, column] += 1.0 / (_GAMMA * h)
    _decompose(matrix, pivot, inverse_pivot)
    for stage in range(4):
        if stage == 1 or stage == 2:
            for row in range(n):
                at[0, places[row]] = y[places[row]] + _A[stage - 1][0] * k[0, row] + _A[stage - 1][1] * k[1, row]
            state_rates(parameters, loads, 1.0, circuit, fast, valve, at, rates)
        for row in range(n):
            value = f0[row] if stage == 0 else rates[0, places[row]]
            for before in range(stage):
                value += _C[stage - 1][before] / h * k[before, row]
            k[stage, row] = value
        _solve(matrix, pivot, inverse_pivot, k[stage])
    for row in range(n):
        y[places[row]] += _B[0] * k[0, row] + _B[1] * k[1, row] + _B[2] * k[2, row] + _B[3] * k[3, row]


@hot
def _decompose(matrix, pivot, inverse_pivot):
    """LU with partial pivoting in place; rows of the pressures and positions differ by 1e9, so pivots matter."""
    n = matrix.shape[0]
    for column in range(n):
        best = column
        for row in range(column + 1, n):
            if abs(matrix[row, column]) > abs(matrix[best, column]):
                best = row
        pivot[column] = best
        if best != column:
            for other in range(n):
                matrix[column, other], matrix[best, other] = matrix[best, other], matrix[column, other]
        inverse_pivot[column] = 1.0 / matrix[column, column]
        for row in range(column + 1, n):
            factor = matrix[row, column] * inverse_pivot[column]
            matrix[row, column] = factor
            for other in range(column + 1, n):
                matrix[row, other] -= factor * matrix[column, other]


@hot
def _solve(matrix, pivot, inverse_pivot, b):
    """Overwrite b with the solution; whole rows were exchanged, so all exchanges come first."""
    n = b.shape[0]
    for row in range(n):
        if pivot[row] != row:
            b[row], b[pivot[row]] = b[pivot[row]], b[row]
    for row in range(n):
        for other in range(row):
            b[row] -= matrix[row, other] * b[other]
    for row in range(n - 1, -1, -1):
        for other in range(row + 1, n):
            b[row] -= matrix[row, other] * b[other]
        b[row] *= inverse_pivot[row]
