"""The certification's plants and runs, as the plant's tests use them, and the article's own reduction of the spool."""

import numpy as np

from hilrunner.base.compiled import entry
from hilrunner.bench.plant_cases import CASES, PERIOD_S, Case, case_named, plant, run, times
from hilrunner.plant.rates_paper import quasi_static_paper_rates

__all__ = ["CASES", "PERIOD_S", "Case", "case_named", "plant", "quasi_static_eigenvalues", "run", "times"]


@entry
def _quasi_static_rates(parameters, loads, command, y, out):
    context = (parameters[0], loads[0], 1.0, command)
    rates, _ = quasi_static_paper_rates(context, (y[0], y[1], y[2], y[3]), (0.0, 0.0, 0))
    for k in range(4):
        out[k] = rates[k]


def quasi_static_eigenvalues(axis_plant, state: np.ndarray, command: float) -> np.ndarray:
    """Eigenvalues of the article's four-state reduction (spool at rest at every instant); 1/s."""
    steps = np.array([1e-9, 1e-6, 50.0, 50.0])
    columns = []
    for k in range(4):
        sides = []
        for sign in (1.0, -1.0):
            y, out = state[:4].copy(), np.empty(4)
            y[k] += sign * steps[k]
            _quasi_static_rates(axis_plant.parameters, axis_plant.load.record(), command, y, out)
            sides.append(out)
        columns.append((sides[0] - sides[1]) / (2 * steps[k]))
    return np.linalg.eigvals(np.stack(columns, axis=-1))
