"""A rival of the surrogate: the first-principle model with its algebraic pressures solved anew in every Runge-Kutta stage.

What a DAE costs that is integrated without any knowledge of it: each stage starts Newton's method from the middle of the
pressure range instead of the last stage's result. Circuit `lift`: two lines, Newton with analytic slope and bracket. Circuit
`paper`: Newton on Eq. (5), which is linear in p_r, so one step and one look at the residual.
"""

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot, inlined
from hilrunner.plant.hydraulics import orifice_root
from hilrunner.plant.line import ITERATION_LIMIT, valve_conductances
from hilrunner.plant.mechanics import pressure_rates, rod_acceleration
from hilrunner.plant.model import PlantModel
from hilrunner.plant.rates_lift import exact_lines_at, make_lift_rates
from hilrunner.plant.rk4 import make_rk4
from hilrunner.plant.spool import cbv_conductance, opening_force, spool_acceleration

NEWTON_LIMIT = 20
_RESIDUAL_RATIO = 1e-12  # of the supply pressure


@inlined
def _cold_lines_at(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines):
    prm = context[0]
    middle = 0.5 * (prm["tank_pressure_pa"] + prm["supply_pressure_pa"])
    forgotten = (middle, middle, lines[2], pressure_1_pa, pressure_2_pa, 0.0, 0.0, lines[7], lines[8])
    return exact_lines_at(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, forgotten)


@hot
def _cold_paper_rates(context, y, lines):
    """The six rates of circuit paper with p_r by Newton from the middle of the range."""
    prm, load, load_scale, command = context
    x, v, p1, p2, spool, speed = y
    tank, transition = prm["tank_pressure_pa"], prm["transition_pressure_pa"]
    drain = prm["valve_bt_si"] * command
    cbv = cbv_conductance(prm, spool)
    floor = prm["series_floor_si"] * prm["series_floor_si"]
    square = cbv * cbv + drain * drain + floor
    return_pa = 0.5 * (tank + prm["supply_pressure_pa"])
    for _ in range(NEWTON_LIMIT):
        residual = ((drain * drain + floor) * (return_pa - tank) - cbv * cbv * (p2 - return_pa)) / square
        if abs(residual) <= _RESIDUAL_RATIO * prm["supply_pressure_pa"]:
            break
        return_pa -= residual  # the slope of the scaled residual is 1
    share = cbv * cbv / square
    flow_1 = prm["valve_pa_si"] * command * orifice_root(prm["supply_pressure_pa"] - p1, transition)
    flow_2 = -drain * orifice_root(return_pa - tank, share * transition) if share > 0.0 else 0.0
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    force = opening_force(prm, p1, p2, 0.0, prm["setting_2_pa"])
    acceleration = rod_acceleration(prm, load, load_scale, x, v, p1, p2)
    return (v, acceleration, rate_1, rate_2, speed, spool_acceleration(prm, force, spool, speed)), lines


_lift = make_rk4(make_lift_rates(_cold_lines_at), 8)
_paper = make_rk4(_cold_paper_rates, 6)


@entry
def _lift_many(parameters, loads, commands, period_s, count, state, states_out):
    prm, load = parameters[0], loads[0]
    y = (state[0], state[1], state[2], state[3], state[4], state[5], state[6], state[7])
    worst = 0
    for i in range(commands.shape[0]):
        context = (prm, load, 1.0, valve_conductances(prm, commands[i]), 0)
        y, lines = _lift(context, y, (state[8], state[9], 0, y[2], y[3], 0.0, 0.0, 0.0, 0.0), period_s / count, count)
        worst = max(worst, lines[2])
        for k in range(8):
            states_out[i, k] = y[k]
        states_out[i, 8], states_out[i, 9] = lines[0], lines[1]
    return worst


@entry
def _paper_many(parameters, loads, commands, period_s, count, state, states_out):
    prm, load = parameters[0], loads[0]
    y = (state[0], state[1], state[2], state[3], state[5], state[7])
    for i in range(commands.shape[0]):
        context = (prm, load, 1.0, max(commands[i], 0.0))
        y, _ = _paper(context, y, (0.0, 0.0, 0), period_s / count, count)
        for k in range(4):
            states_out[i, k] = y[k]
        states_out[i, 5], states_out[i, 7] = y[4], y[5]
    return 0


def cold_newton_states(model: PlantModel, commands: np.ndarray, period_s: float, start: np.ndarray) -> np.ndarray:
    """The first axis of a model over held commands, load factor 1: float64[n, 10].

    Raises:
        ArithmeticError: a Newton solve stopped at its limit.
    """
    run = _lift_many if model.circuit[0] == status.CIRCUIT_LIFT else _paper_many
    states = np.zeros((len(commands), 10))
    count = int(model.substep_count[0])
    worst = run(model.parameters, model.load, commands, period_s, count, start.copy(), states)
    if worst > ITERATION_LIMIT:
        raise ArithmeticError("a line solve from the middle of the range did not converge")
    return states
