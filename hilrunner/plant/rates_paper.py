"""Right-hand sides of the article's circuit (Eq. 9): lifting only, one counterbalance valve in the return of chamber 2.

Eq. (5) is linear in p_r, so the algebraic pressure has a closed form and the model is an explicit ODE:

    p_r = p_t + kappa (p2 - p_t),  kappa = K_c^2 / (K_c^2 + K_T^2 + eps^2)
    q_2 = K_eq phi(p2 - p_t),      K_eq  = K_c K_T / sqrt(K_c^2 + K_T^2 + eps^2)

phi acts on the total drop: regularised on p_r alone a nearly shut valve would pass three times too little.
The spool is number 2 of the state layout; it is piloted by chamber 1 (Eq. 6).
"""

import math

from hilrunner.base.compiled import inlined
from hilrunner.plant.hydraulics import orifice_root
from hilrunner.plant.mechanics import pressure_rates, rod_acceleration
from hilrunner.plant.spool import cbv_conductance, mass_free_spool_speed, opening_force, spool_acceleration


@inlined
def paper_flows(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command):
    """(q_1 into chamber 1, q_2 into chamber 2 (negative when it drains), p_r); Eq. (2)-(5)."""
    supply = prm["valve_pa_si"] * valve_command
    drain = prm["valve_bt_si"] * valve_command
    tank = prm["tank_pressure_pa"]
    transition = prm["transition_pressure_pa"]
    square = cbv_si * cbv_si + drain * drain + prm["series_floor_si"] * prm["series_floor_si"]
    flow_1 = supply * orifice_root(prm["supply_pressure_pa"] - pressure_1_pa, transition)
    flow_2 = -cbv_si * drain / math.sqrt(square) * orifice_root(pressure_2_pa - tank, transition)
    return flow_1, flow_2, tank + cbv_si * cbv_si / square * (pressure_2_pa - tank)


@inlined
def paper_rates(context, y, lines):
    """x, v, p1, p2, x_c, w_c: the complete model. `context` = (prm, load, load_scale, valve_command)."""
    prm, load, load_scale, valve_command = context
    x, v, p1, p2, spool, speed = y
    flow_1, flow_2, _ = paper_flows(prm, p1, p2, cbv_conductance(prm, spool), valve_command)
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    force = opening_force(prm, p1, p2, 0.0, prm["setting_2_pa"])
    acceleration = rod_acceleration(prm, load, load_scale, x, v, p1, p2)
    return (v, acceleration, rate_1, rate_2, speed, spool_acceleration(prm, force, spool, speed)), lines


@inlined
def mass_free_paper_rates(context, y, lines):
    """x, v, p1, p2, x_c: spool without mass."""
    prm, load, load_scale, valve_command = context
    x, v, p1, p2, spool = y
    flow_1, flow_2, _ = paper_flows(prm, p1, p2, cbv_conductance(prm, spool), valve_command)
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    force = opening_force(prm, p1, p2, 0.0, prm["setting_2_pa"])
    acceleration = rod_acceleration(prm, load, load_scale, x, v, p1, p2)
    return (v, acceleration, rate_1, rate_2, mass_free_spool_speed(prm, force, spool)), lines


@inlined
def quasi_static_spool_m(prm, pressure_1_pa, pressure_2_pa):
    """Where the spool would rest: spring against pilot, rigid stops (exact on a stop, unstable where it modulates)."""
    force = opening_force(prm, pressure_1_pa, pressure_2_pa, 0.0, prm["setting_2_pa"])
    return min(max(force / prm["spool_spring_npm"], 0.0), prm["spool_stroke_m"])


@inlined
def quasi_static_paper_rates(context, y, lines):
    """x, v, p1, p2: the article's own reduction, spool at rest at every instant."""
    prm, load, load_scale, valve_command = context
    x, v, p1, p2 = y
    spool = quasi_static_spool_m(prm, p1, p2)
    flow_1, flow_2, _ = paper_flows(prm, p1, p2, cbv_conductance(prm, spool), valve_command)
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    return (v, rod_acceleration(prm, load, load_scale, x, v, p1, p2), rate_1, rate_2), lines
