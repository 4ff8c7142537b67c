"""The circuits as differential-algebraic equations F(y, y', inputs) = 0, algebraic pressures kept as unknowns.

| circuit | unknowns | algebraic |
| --- | --- | --- |
| paper | x, v, p1, p2, x_c, w_c, p_r | p_r by Eq. (5), which is linear in it |
| lift | x, v, p1, p2, x_1, x_2, w_1, w_2, p_a, p_b | p_a, p_b by the balance of their lines |
| lift-lines | the same ten | none: the lines hold oil |

Row i of a differential unknown is y_i' - f_i; an algebraic row is its equation scaled to the size of a pressure rate.
"""

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import hot
from hilrunner.plant.hydraulics import orifice_root
from hilrunner.plant.line import (
    chamber_side_flow,
    line_balance,
    solve_line,
    valve_conductances,
)
from hilrunner.plant.load import LOAD
from hilrunner.plant.mechanics import pressure_rates, rod_acceleration
from hilrunner.plant.parameters import PARAMETERS
from hilrunner.plant.rates_lines import lift_lines_rates
from hilrunner.plant.rates_paper import paper_flows, paper_rates
from hilrunner.plant.spool import cbv_conductance, opening_force, spool_acceleration

# everything a residual needs, in one flat record
PLANT_INPUT = np.dtype(
    [
        ("valve_command", "f8"),
        ("load_scale", "f8"),
        ("circuit", "i8"),  # status.CIRCUIT_*
        ("parameters", PARAMETERS),
        ("load", LOAD),
    ]
)

# unknowns of each circuit as places of base.state_layout; the algebraic ones come last
UNKNOWNS = {
    status.CIRCUIT_PAPER: (0, 1, 2, 3, 5, 7, 9),
    status.CIRCUIT_LIFT: (0, 1, 2, 3, 4, 5, 6, 7, 8, 9),
    status.CIRCUIT_LIFT_LINES: (0, 1, 2, 3, 4, 5, 6, 7, 8, 9),
}
ALGEBRAIC_COUNT = {status.CIRCUIT_PAPER: 1, status.CIRCUIT_LIFT: 2, status.CIRCUIT_LIFT_LINES: 0}

_REFERENCE_VOLUME_M3 = 1e-3  # turns a flow that gathers in a line into the rate of a pressure


@hot
def residual(plant, y, dy, r):
    """F(y, y') of the plant's circuit into r; all float64, length as UNKNOWNS."""
    if plant["circuit"] == status.CIRCUIT_LIFT:
        lift_residual(plant, y, dy, r)
    elif plant["circuit"] == status.CIRCUIT_LIFT_LINES:
        lift_lines_residual(plant, y, dy, r)
    else:
        paper_residual(plant, y, dy, r)


@hot
def paper_residual(plant, y, dy, r):
    """Eq. (9) with Eq. (5) as its last row: (K_T^2 + eps^2)(p_r - p_t) - K_c^2 (p2 - p_r) = 0."""
    prm = plant["parameters"]
    command = max(plant["valve_command"], 0.0)
    supply = prm["valve_pa_si"] * command
    drain = prm["valve_bt_si"] * command
    tank = prm["tank_pressure_pa"]
    transition = prm["transition_pressure_pa"]
    cbv = cbv_conductance(prm, y[4])
    floor_square = prm["series_floor_si"] * prm["series_floor_si"]
    square = cbv * cbv + drain * drain + floor_square
    # the drain edge sees p_r - p_t and its share of the transition pressure, so that both orifices pass the same
    share = cbv * cbv / square
    flow_1 = supply * orifice_root(prm["supply_pressure_pa"] - y[2], transition)
    flow_2 = -drain * orifice_root(y[6] - tank, share * transition) if share > 0.0 else 0.0
    rate_1, rate_2 = pressure_rates(prm, y[0], y[1], y[2], y[3], flow_1, flow_2)
    force = opening_force(prm, y[2], y[3], 0.0, prm["setting_2_pa"])
    r[0] = dy[0] - y[1]
    r[1] = dy[1] - rod_acceleration(prm, plant["load"], plant["load_scale"], y[0], y[1], y[2], y[3])
    r[2] = dy[2] - rate_1
    r[3] = dy[3] - rate_2
    r[4] = dy[4] - y[5]
    r[5] = dy[5] - spool_acceleration(prm, force, y[4], y[5])
    r[6] = ((drain * drain + floor_square) * (y[6] - tank) - cbv * cbv * (y[3] - y[6])) / square


@hot
def lift_residual(plant, y, dy, r):
    """`lift` with both line balances as its last rows."""
    prm = plant["parameters"]
    supply_a, return_a, supply_b, return_b = valve_conductances(prm, plant["valve_command"])
    cbv_1 = cbv_conductance(prm, y[4])
    cbv_2 = cbv_conductance(prm, y[5])
    flow_1, _ = chamber_side_flow(prm, y[8], y[2], cbv_1)
    flow_2, _ = chamber_side_flow(prm, y[9], y[3], cbv_2)
    rate_1, rate_2 = pressure_rates(prm, y[0], y[1], y[2], y[3], flow_1, flow_2)
    force_1 = opening_force(prm, y[9], y[2], y[8], prm["setting_1_pa"])
    force_2 = opening_force(prm, y[8], y[3], y[9], prm["setting_2_pa"])
    scale = prm["bulk_modulus_pa"] / _REFERENCE_VOLUME_M3
    r[0] = dy[0] - y[1]
    r[1] = dy[1] - rod_acceleration(prm, plant["load"], plant["load_scale"], y[0], y[1], y[2], y[3])
    r[2] = dy[2] - rate_1
    r[3] = dy[3] - rate_2
    r[4] = dy[4] - y[6]
    r[5] = dy[5] - y[7]
    r[6] = dy[6] - spool_acceleration(prm, force_1, y[4], y[6])
    r[7] = dy[7] - spool_acceleration(prm, force_2, y[5], y[7])
    r[8] = -scale * line_balance(prm, y[8], y[2], cbv_1, supply_a, return_a)
    r[9] = -scale * line_balance(prm, y[9], y[3], cbv_2, supply_b, return_b)


@hot
def lift_lines_residual(plant, y, dy, r):
    """`lift-lines`: ten differential rows."""
    prm = plant["parameters"]
    context = (prm, plant["load"], plant["load_scale"], valve_conductances(prm, plant["valve_command"]))
    state = (y[0], y[1], y[2], y[3], y[4], y[5], y[6], y[7], y[8], y[9])
    rates, _ = lift_lines_rates(context, state, (0.0, 0.0, 0))
    for k in range(10):
        r[k] = dy[k] - rates[k]


@hot
def make_consistent(plant, y, dy):
    """Solve the algebraic unknowns in y and the rates in dy for the plant's inputs; returns the worst iteration count."""
    prm = plant["parameters"]
    worst = 0
    if plant["circuit"] == status.CIRCUIT_LIFT:
        supply_a, return_a, supply_b, return_b = valve_conductances(prm, plant["valve_command"])
        cbv_1 = cbv_conductance(prm, y[4])
        cbv_2 = cbv_conductance(prm, y[5])
        for _ in range(2):  # the second call starts on the first one's result and squares its error away
            y[8], _, count_a, _ = solve_line(prm, y[2], cbv_1, supply_a, return_a, y[8])
            y[9], _, count_b, _ = solve_line(prm, y[3], cbv_2, supply_b, return_b, y[9])
            worst = max(worst, count_a, count_b)
        _rates_from_residual(plant, y, dy, 8)
        dy[8] = 0.0
        dy[9] = 0.0
    elif plant["circuit"] == status.CIRCUIT_LIFT_LINES:
        _rates_from_residual(plant, y, dy, 10)
    else:
        command = max(plant["valve_command"], 0.0)
        _, _, y[6] = paper_flows(prm, y[2], y[3], cbv_conductance(prm, y[4]), command)
        context = (prm, plant["load"], plant["load_scale"], command)
        rates, _ = paper_rates(context, (y[0], y[1], y[2], y[3], y[4], y[5]), (0.0, 0.0, 0))
        for k in range(6):
            dy[k] = rates[k]
        dy[6] = 0.0
    return worst


@hot
def _rates_from_residual(plant, y, dy, count):
    """The first `count` rates: what the residual lacks when y' is 0."""
    for k in range(dy.shape[0]):
        dy[k] = 0.0
    # r = 0 - f, written over dy itself: each row reads only its own dy, before it is written
    residual(plant, y, dy, dy)
    for k in range(count):
        dy[k] = -dy[k]
