"""Right-hand sides of the two-way double-counterbalance circuit `lift`, line pressures eliminated by the line solver.

States of the full model: x, v, p1, p2, x_1, x_2, w_1, w_2 (rod, chambers, spools); of the mass-free one the first six.
Spool 1 guards chamber 1 and is piloted by line b, spool 2 guards chamber 2 and is piloted by line a: lines, not chambers,
because pressure trapped in a chamber would keep the other valve open after a stop and let the load sink.

`context` = (prm, load, load_scale, conductances, line_context); `lines` = (p_a, p_b, worst iteration count) carries the
line pressures of the stage before as the next guess.
"""

from hilrunner.base.compiled import hot
from hilrunner.plant.line import solve_line, solve_return_line, solve_supply_line
from hilrunner.plant.mechanics import pressure_rates, rod_acceleration
from hilrunner.plant.spool import cbv_conductance, mass_free_spool_speed, opening_force, spool_acceleration


def make_lines(supply_line, return_line):
    """Both line solves of `lift` from two branch functions (the exact ones of plant.line, or networks).

    A branch function: (line_context, prm, chamber_pa, cbv_si, valve_si, guess_pa) -> (line_pa, flow_m3ps, iterations).
    """

    @hot
    def one_line(line_context, prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa):
        if return_si == 0.0:
            return supply_line(line_context, prm, chamber_pa, cbv_si, supply_si, guess_pa)
        if supply_si == 0.0:
            return return_line(line_context, prm, chamber_pa, cbv_si, return_si, guess_pa)
        return solve_line(prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa)

    @hot
    def lines_at(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines):
        """(p_a, p_b, q_1, q_2, worst iteration count) at a state; flows positive into the chambers."""
        prm, _, _, conductances, line_context = context
        supply_a, return_a, supply_b, return_b = conductances
        line_a, flow_1, count_a = one_line(
            line_context, prm, pressure_1_pa, cbv_conductance(prm, spool_1_m), supply_a, return_a, lines[0]
        )
        line_b, flow_2, count_b = one_line(
            line_context, prm, pressure_2_pa, cbv_conductance(prm, spool_2_m), supply_b, return_b, lines[1]
        )
        return line_a, line_b, flow_1, flow_2, max(lines[2], count_a, count_b)

    return lines_at


def make_lift_rates(lines_at):
    """The eight rates of the full model over a `lines_at` of make_lines."""

    @hot
    def rates(context, y, lines):
        prm, load, load_scale, _, _ = context
        x, v, p1, p2, s1, s2, w1, w2 = y
        line_a, line_b, flow_1, flow_2, worst = lines_at(context, p1, p2, s1, s2, lines)
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
        )
        return derivative, (line_a, line_b, worst)

    return rates


def make_mass_free_rates(lines_at):
    """The six rates with spools without mass, over a `lines_at` of make_lines."""

    @hot
    def rates(context, y, lines):
        prm, load, load_scale, _, _ = context
        x, v, p1, p2, s1, s2 = y
        line_a, line_b, flow_1, flow_2, worst = lines_at(context, p1, p2, s1, s2, lines)
        rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
        force_1 = opening_force(prm, line_b, p1, line_a, prm["setting_1_pa"])
        force_2 = opening_force(prm, line_a, p2, line_b, prm["setting_2_pa"])
        derivative = (
            v,
            rod_acceleration(prm, load, load_scale, x, v, p1, p2),
            rate_1,
            rate_2,
            mass_free_spool_speed(prm, force_1, s1),
            mass_free_spool_speed(prm, force_2, s2),
        )
        return derivative, (line_a, line_b, worst)

    return rates


exact_lines_at = make_lines(solve_supply_line, solve_return_line)
lift_rates = make_lift_rates(exact_lines_at)
mass_free_lift_rates = make_mass_free_rates(exact_lines_at)
