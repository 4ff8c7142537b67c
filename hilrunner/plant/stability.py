"""How large an RK4 step may be: eigenvalues of the Jacobian over the states a profile can reach."""

import math
from functools import lru_cache

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.base.errors import StateError
from hilrunner.plant.initial import initial_state, static_load_n
from hilrunner.plant.line import valve_conductances
from hilrunner.plant.rates_lift import exact_lines_at, lift_rates, mass_free_lift_rates, start_lines
from hilrunner.plant.rates_lines import lift_lines_rates
from hilrunner.plant.rates_paper import mass_free_paper_rates, paper_rates

# finite-difference step of each place of the state
_STEP = np.array([1e-9, 1e-6, 50.0, 50.0, 1e-9, 1e-9, 1e-6, 1e-6, 50.0, 50.0])
_ACTIVE = {
    (status.CIRCUIT_PAPER, False): (0, 1, 2, 3, 5, 7),
    (status.CIRCUIT_PAPER, True): (0, 1, 2, 3, 5),
    (status.CIRCUIT_LIFT, False): (0, 1, 2, 3, 4, 5, 6, 7),
    (status.CIRCUIT_LIFT, True): (0, 1, 2, 3, 4, 5),
    (status.CIRCUIT_LIFT_LINES, False): (0, 1, 2, 3, 4, 5, 6, 7, 8, 9),
    (status.CIRCUIT_LIFT_LINES, True): (0, 1, 2, 3, 4, 5, 6, 7, 8, 9),
}
_COMMANDS = (0.0, 0.05, 0.3, 1.0)
SAFETY = 0.97  # of the limit, for what lies between the sampled states


def spools_have_no_mass(axis_plant) -> bool:
    """True where the axis' engine integrates spools without mass: the fast reference and every surrogate."""
    return bool(axis_plant.fast) or axis_plant.engine != status.ENGINE_REFERENCE


def active_places(circuit: int, fast: bool) -> tuple[int, ...]:
    """Places of base.state_layout that are integrated states of a circuit."""
    return _ACTIVE[circuit, bool(fast)]


@entry
def state_rates(parameters, loads, load_scale, circuit, fast, valve_command, states, rates_out):
    """Time derivatives of states (n, 10) into rates_out (n, 10); derived places get 0. Line pressures are solved first."""
    prm = parameters[0]
    load = loads[0]
    conductances = valve_conductances(prm, valve_command)
    lift_context = (prm, load, load_scale, conductances, 0)
    for i in range(states.shape[0]):
        y = states[i]
        d = rates_out[i]
        d[:] = 0.0
        if circuit == status.CIRCUIT_LIFT and not fast:
            lines, _, _ = exact_lines_at(lift_context, y[2], y[3], y[4], y[5], start_lines(y))
            r8, _ = lift_rates(lift_context, (y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7]), lines)
            for k in range(8):
                d[k] = r8[k]
        elif circuit == status.CIRCUIT_LIFT:
            lines, _, _ = exact_lines_at(lift_context, y[2], y[3], y[4], y[5], start_lines(y))
            r6, _ = mass_free_lift_rates(lift_context, (y[0], y[1], y[2], y[3], y[4], y[5]), lines)
            for k in range(6):
                d[k] = r6[k]
        elif circuit == status.CIRCUIT_LIFT_LINES:
            y10 = (y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9])
            r10, _ = lift_lines_rates((prm, load, load_scale, conductances), y10, (0.0, 0.0, 0))
            for k in range(10):
                d[k] = r10[k]
        else:
            context = (prm, load, load_scale, max(valve_command, 0.0))
            if fast:
                r5, _ = mass_free_paper_rates(context, (y[0], y[1], y[2], y[3], y[5]), (0.0, 0.0, 0))
                d[0], d[1], d[2], d[3], d[5] = r5[0], r5[1], r5[2], r5[3], r5[4]
            else:
                r, _ = paper_rates(context, (y[0], y[1], y[2], y[3], y[5], y[7]), (0.0, 0.0, 0))
                d[0], d[1], d[2], d[3], d[5], d[7] = r[0], r[1], r[2], r[3], r[4], r[5]


def jacobians(axis_plant, states: np.ndarray, valve_command: float, load_scale: float = 1.0) -> np.ndarray:
    """(n, m, m) Jacobians over the active places, central differences; units as the state's."""
    fast = spools_have_no_mass(axis_plant)
    places = active_places(axis_plant.circuit, fast)
    columns = []
    for place in places:
        sides = []
        for sign in (1.0, -1.0):
            moved = states.copy()
            moved[:, place] += sign * _STEP[place]
            rates = np.empty_like(moved)
            state_rates(
                axis_plant.parameters, axis_plant.load.record(), float(load_scale), axis_plant.circuit,
                fast, float(valve_command), moved, rates,
            )  # fmt: skip
            sides.append(rates[:, places])
        columns.append((sides[0] - sides[1]) / (2.0 * _STEP[place]))
    return np.stack(columns, axis=-1)


def eigenvalues(axis_plant, states: np.ndarray, valve_command: float, load_scale: float = 1.0) -> np.ndarray:
    """(n, m) complex eigenvalues of the Jacobians; 1/s."""
    return np.linalg.eigvals(jacobians(axis_plant, states, valve_command, load_scale))


def stable_step_s(values: np.ndarray) -> float:
    """Largest RK4 step that damps every decaying eigenvalue and resolves every other one; s."""
    values = np.asarray(values).ravel()
    values = values[np.abs(values) > 1e-3]
    if values.size == 0:
        return math.inf
    decaying = values[values.real < 0.0]
    other = values[values.real >= 0.0]
    limit = math.inf if other.size == 0 else 2.5 / np.abs(other).max()
    if decaying.size:
        # |R| < 1 all the way from 0 to the limit: scan along each ray, in units of 1/|lambda|
        radius = np.linspace(0.01, 3.0, 600)
        z = radius[:, None] * (decaying / np.abs(decaying))[None, :]
        growth = np.abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0))))
        outside = growth > 1.0 + 1e-12
        first = np.where(outside.any(axis=0), outside.argmax(axis=0), len(radius))
        limit = min(limit, float((radius[np.maximum(first - 1, 0)] / np.abs(decaying)).min()))
    return limit


def sampled_states(axis_plant) -> list[tuple[float, np.ndarray]]:
    """(command, states (n, 10)) over the profile's range: positions, pressures, spools shut, sliding, half open and open."""
    prm = axis_plant.parameters[0]
    low, high = axis_plant.position_limits_m
    positions = np.unique(np.concatenate([np.linspace(low, high, 5), [low + 0.02 * (high - low)]]))
    commands = (
        _COMMANDS
        if axis_plant.circuit == status.CIRCUIT_PAPER
        else tuple(sign * value for value in _COMMANDS for sign in ((1.0, -1.0) if value else (1.0,)))
    )
    stroke = prm["spool_stroke_m"]
    seat = prm["spool_area_m2"] * max(prm["setting_1_pa"], prm["setting_2_pa"]) / prm["spool_stop_stiffness_npm"]
    fast_m_s = 10.0 * prm["friction_speed_mps"]
    groups = []
    for command in commands:
        rows = []
        for x in positions:
            base = _starting_point(axis_plant, float(x), command)
            for spool, speed in ((base[5], 0.0), (-seat, 0.0), (0.5 * stroke, 0.0), (0.5 * stroke, fast_m_s),
                                 (stroke + seat, 0.0)):  # fmt: skip
                row = base.copy()
                row[4], row[5] = (spool if axis_plant.circuit != status.CIRCUIT_PAPER else 0.0), spool
                row[6], row[7] = speed, speed
                rows.append(row)
            rows.extend(_stalled(prm, base))
        groups.append((command, np.array(rows)))
    return groups


def _stalled(prm, base: np.ndarray) -> list[np.ndarray]:
    """At a stroke end: the rod pressed into its stop by the full supply pressure, where the stop damps hardest."""
    if base[0] <= 0.0:
        depth = prm["rod_side_area_m2"] * prm["supply_pressure_pa"] / prm["end_stop_stiffness_npm"]
        stalled = base.copy()
        stalled[0], stalled[1] = -depth, 0.0
        return [stalled]
    if base[0] >= prm["stroke_m"]:
        depth = prm["bore_area_m2"] * prm["supply_pressure_pa"] / prm["end_stop_stiffness_npm"]
        stalled = base.copy()
        stalled[0], stalled[1] = prm["stroke_m"] + depth, 0.0
        return [stalled]
    return []


def _starting_point(axis_plant, x: float, command: float) -> np.ndarray:
    try:
        return initial_state(axis_plant, x, command)
    except StateError:
        prm = axis_plant.parameters[0]
        state = np.zeros(10)
        state[0] = x
        state[3] = prm["rest_pressure_2_pa"]
        force = static_load_n(axis_plant.load, x) + prm["rod_side_area_m2"] * state[3]
        state[2] = max(force / prm["bore_area_m2"], prm["tank_pressure_pa"])
        state[8] = state[9] = prm["tank_pressure_pa"]
        return state


def stability_limit_s(axis_plant) -> float:
    """Largest stable RK4 step over the axis' position range, all commands, spools shut, moving and open; s."""
    values = [eigenvalues(axis_plant, states, command) for command, states in sampled_states(axis_plant)]
    return min(stable_step_s(group) for group in values)


@lru_cache(maxsize=64)
def default_substep_count(axis_plant, period_s: float) -> int:
    """Fewest RK4 steps a period that keep SAFETY below the stability limit."""
    return max(1, math.ceil(period_s / (SAFETY * stability_limit_s(axis_plant))))
