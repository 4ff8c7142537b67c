"""Right-hand side of `lift-lines`: the circuit of `lift` with the oil of its hoses, ten states and no inner solve."""

from hilrunner.base.compiled import inlined
from hilrunner.plant.line import chamber_side_flow, valve_side_flow
from hilrunner.plant.mechanics import above_vacuum, pressure_rate, pressure_rates, rod_acceleration
from hilrunner.plant.spool import cbv_conductance, opening_force, spool_acceleration


@inlined
def lift_lines_rates(context, y, lines):
    """x, v, p1, p2, x_1, x_2, w_1, w_2, p_a, p_b. `context` = (prm, load, load_scale, conductances)."""
    prm, load, load_scale, conductances = context
    supply_a, return_a, supply_b, return_b = conductances
    x, v, p1, p2, s1, s2, w1, w2, line_a, line_b = y
    into_a, _ = valve_side_flow(prm, line_a, supply_a, return_a)
    into_b, _ = valve_side_flow(prm, line_b, supply_b, return_b)
    flow_1, _ = chamber_side_flow(prm, line_a, p1, cbv_conductance(prm, s1))
    flow_2, _ = chamber_side_flow(prm, line_b, p2, cbv_conductance(prm, s2))
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    force_1 = opening_force(prm, line_b, p1, line_a, prm["setting_1_pa"])
    force_2 = opening_force(prm, line_a, p2, line_b, prm["setting_2_pa"])
    derivative = (
        v,
        rod_acceleration(prm, load, load_scale, x, v, p1, p2),
        rate_1,
        rate_2,
        w1,
        w2,
        spool_acceleration(prm, force_1, s1, w1),
        spool_acceleration(prm, force_2, s2, w2),
        pressure_rate(prm, line_a, prm["line_volume_a_m3"], into_a - flow_1),
        pressure_rate(prm, line_b, prm["line_volume_b_m3"], into_b - flow_2),
    )
    return derivative, lines


@inlined
def pressures_above_vacuum(context, y):
    """The ten states after an integrator's step, no pressure below absolute vacuum."""
    prm = context[0]
    p1, p2, line_a, line_b = (
        above_vacuum(prm, y[2]), above_vacuum(prm, y[3]), above_vacuum(prm, y[8]), above_vacuum(prm, y[9])
    )  # fmt: skip
    return y[0], y[1], p1, p2, y[4], y[5], y[6], y[7], line_a, line_b
