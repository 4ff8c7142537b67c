"""Right-hand sides of the two-way double-counterbalance circuit `lift`, line pressures eliminated by the line solver.

States of the full model: x, v, p1, p2, x_1, x_2, w_1, w_2 (rod, chambers, spools); of the mass-free one the first six.
Spool 1 guards chamber 1 and is piloted by line b, spool 2 guards chamber 2 and is piloted by line a: lines, not chambers,
because pressure trapped in a chamber would keep the other valve open after a stop and let the load sink.

`context` = (prm, load, load_scale, conductances, line_context).
`lines` carries what the last stage found, as the next one's starting guesses; it takes no part in the method:
(p_a, p_b, worst iteration count, p1, p2, d p_a / d p1, d p_b / d p2, spool speed ratio 1, spool speed ratio 2).
"""

from hilrunner.base.compiled import inlined
from hilrunner.plant.line import solve_line
from hilrunner.plant.mechanics import pressure_rates, rod_acceleration
from hilrunner.plant.spool import cbv_conductance, mass_free_spool_ratio, opening_force, spool_acceleration


@inlined
def start_lines(state):
    """The carry before the first stage, from an axis' state."""
    return state[8], state[9], 0, state[2], state[3], 0.0, 0.0, 0.0, 0.0


def make_lines(supply_line, return_line):
    """Both line solves of `lift` from two branch functions, exact near the valve's centre where both edges are open.

    A branch function: (line_context, prm, chamber_pa, cbv_si, valve_si, guess_pa) -> (line_pa, flow_m3ps, iterations).

    Returns:
        hot (context, p1, p2, x_1, x_2, lines) -> (lines, q_1, q_2), flows positive into the chambers.
    """

    @inlined
    def one_line(line_context, prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa):
        if return_si == 0.0:
            line, flow, count = supply_line(line_context, prm, chamber_pa, cbv_si, supply_si, guess_pa)
            return line, flow, count, 0.0
        if supply_si == 0.0:
            line, flow, count = return_line(line_context, prm, chamber_pa, cbv_si, return_si, guess_pa)
            return line, flow, count, 0.0
        return solve_line(prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa)

    return _make_lines(one_line)


@inlined
def _exact_line(line_context, prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa):
    return solve_line(prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa)


def _make_lines(one_line):
    @inlined
    def lines_at(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines):
        prm, _, _, conductances, line_context = context
        supply_a, return_a, supply_b, return_b = conductances
        # a line follows its chamber: guess along the slope found last
        guess_a = lines[0] + lines[5] * (pressure_1_pa - lines[3])
        guess_b = lines[1] + lines[6] * (pressure_2_pa - lines[4])
        line_a, flow_1, count_a, ratio_a = one_line(
            line_context, prm, pressure_1_pa, cbv_conductance(prm, spool_1_m), supply_a, return_a, guess_a
        )
        line_b, flow_2, count_b, ratio_b = one_line(
            line_context, prm, pressure_2_pa, cbv_conductance(prm, spool_2_m), supply_b, return_b, guess_b
        )
        worst = max(lines[2], count_a, count_b)
        found = (line_a, line_b, worst, pressure_1_pa, pressure_2_pa, ratio_a, ratio_b, lines[7], lines[8])
        return found, flow_1, flow_2

    return lines_at


def make_lift_rates(lines_at):
    """The eight rates of the full model over a `lines_at` of make_lines."""

    @inlined
    def rates(context, y, lines):
        prm, load, load_scale, _, _ = context
        x, v, p1, p2, s1, s2, w1, w2 = y
        lines, flow_1, flow_2 = lines_at(context, p1, p2, s1, s2, lines)
        rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
        force_1 = opening_force(prm, lines[1], p1, lines[0], prm["setting_1_pa"])
        force_2 = opening_force(prm, lines[0], p2, lines[1], prm["setting_2_pa"])
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
        return derivative, lines

    return rates


def make_mass_free_rates(lines_at):
    """The six rates with spools without mass, over a `lines_at` of make_lines."""

    @inlined
    def rates(context, y, lines):
        prm, load, load_scale, _, _ = context
        x, v, p1, p2, s1, s2 = y
        lines, flow_1, flow_2 = lines_at(context, p1, p2, s1, s2, lines)
        rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
        force_1 = opening_force(prm, lines[1], p1, lines[0], prm["setting_1_pa"])
        force_2 = opening_force(prm, lines[0], p2, lines[1], prm["setting_2_pa"])
        ratio_1 = mass_free_spool_ratio(prm, force_1, s1, lines[7])
        ratio_2 = mass_free_spool_ratio(prm, force_2, s2, lines[8])
        derivative = (
            v,
            rod_acceleration(prm, load, load_scale, x, v, p1, p2),
            rate_1,
            rate_2,
            prm["friction_speed_mps"] * ratio_1,
            prm["friction_speed_mps"] * ratio_2,
        )
        return derivative, (*lines[:7], ratio_1, ratio_2)

    return rates


exact_lines_at = _make_lines(_exact_line)
lift_rates = make_lift_rates(exact_lines_at)
mass_free_lift_rates = make_mass_free_rates(exact_lines_at)
