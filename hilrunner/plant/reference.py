"""The first-principle models integrated through one period with inputs held: the engine `reference`."""

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.plant.line import ITERATION_LIMIT, valve_conductances
from hilrunner.plant.mechanics import chambers_above_vacuum
from hilrunner.plant.rates_lift import exact_lines_at, lift_rates, mass_free_lift_rates, start_lines
from hilrunner.plant.rates_lines import lift_lines_rates, pressures_above_vacuum
from hilrunner.plant.rates_paper import mass_free_paper_rates, paper_flows, paper_rates
from hilrunner.plant.rk4 import make_rk4
from hilrunner.plant.spool import cbv_conductance, mass_free_spool_speed, opening_force

_lift = make_rk4(lift_rates, 8, chambers_above_vacuum)
_lift_mass_free = make_rk4(mass_free_lift_rates, 6, chambers_above_vacuum)
_lift_lines = make_rk4(lift_lines_rates, 10, pressures_above_vacuum)
_paper = make_rk4(paper_rates, 6, chambers_above_vacuum)
_paper_mass_free = make_rk4(mass_free_paper_rates, 5, chambers_above_vacuum)


@entry  # cached by itself: what calls it need not compile it again
def advance_lift(prm, load, load_scale, valve_command, period_s, count, fast, state):
    """`lift` through one period, exact line pressures; returns status.FLAG_SOLVER_LIMIT or 0."""
    context = (prm, load, load_scale, valve_conductances(prm, valve_command), 0)
    lines = start_lines(state)
    if fast:
        y6 = (state[0], state[1], state[2], state[3], state[4], state[5])
        y6, lines = _lift_mass_free(context, y6, lines, period_s / count, count)
        lines, _, _ = exact_lines_at(context, y6[2], y6[3], y6[4], y6[5], lines)
        store_mass_free_lift(prm, y6, lines[0], lines[1], state)
    else:
        y = (state[0], state[1], state[2], state[3], state[4], state[5], state[6], state[7])
        y, lines = _lift(context, y, lines, period_s / count, count)
        lines, _, _ = exact_lines_at(context, y[2], y[3], y[4], y[5], lines)
        state[0], state[1], state[2], state[3] = y[0], y[1], y[2], y[3]
        state[4], state[5], state[6], state[7] = y[4], y[5], y[6], y[7]
        state[8], state[9] = lines[0], lines[1]
    return status.FLAG_SOLVER_LIMIT if lines[2] > ITERATION_LIMIT else 0


@hot
def store_mass_free_lift(prm, y, line_a_pa, line_b_pa, state):
    """Write six states, the line pressures and the spool speeds these imply into an axis' state."""
    state[0], state[1], state[2], state[3] = y[0], y[1], y[2], y[3]
    state[4], state[5] = y[4], y[5]
    force_1 = opening_force(prm, line_b_pa, y[2], line_a_pa, prm["setting_1_pa"])
    force_2 = opening_force(prm, line_a_pa, y[3], line_b_pa, prm["setting_2_pa"])
    state[6] = mass_free_spool_speed(prm, force_1, y[4])
    state[7] = mass_free_spool_speed(prm, force_2, y[5])
    state[8], state[9] = line_a_pa, line_b_pa


@entry  # cached by itself: what calls it need not compile it again
def advance_lift_lines(prm, load, load_scale, valve_command, period_s, count, state):
    """`lift-lines` through one period."""
    context = (prm, load, load_scale, valve_conductances(prm, valve_command))
    y = (
        state[0], state[1], state[2], state[3], state[4], state[5], state[6], state[7], state[8], state[9]
    )  # fmt: skip
    y, _ = _lift_lines(context, y, (0.0, 0.0, 0), period_s / count, count)
    state[0], state[1], state[2], state[3], state[4] = y[0], y[1], y[2], y[3], y[4]
    state[5], state[6], state[7], state[8], state[9] = y[5], y[6], y[7], y[8], y[9]


@entry  # cached by itself: what calls it need not compile it again
def advance_paper(prm, load, load_scale, valve_command, period_s, count, fast, state):
    """The article's circuit through one period; commands below 0 act as 0."""
    command = max(valve_command, 0.0)
    context = (prm, load, load_scale, command)
    lines = (0.0, 0.0, 0)
    if fast:
        y5 = (state[0], state[1], state[2], state[3], state[5])
        y5, _ = _paper_mass_free(context, y5, lines, period_s / count, count)
        state[0], state[1], state[2], state[3], state[5] = y5[0], y5[1], y5[2], y5[3], y5[4]
        force = opening_force(prm, y5[2], y5[3], 0.0, prm["setting_2_pa"])
        state[7] = mass_free_spool_speed(prm, force, y5[4])
    else:
        y = (state[0], state[1], state[2], state[3], state[5], state[7])
        y, _ = _paper(context, y, lines, period_s / count, count)
        state[0], state[1], state[2], state[3], state[5], state[7] = y[0], y[1], y[2], y[3], y[4], y[5]
    store_paper_lines(prm, command, state)


@hot
def store_paper_lines(prm, valve_command, state):
    """Fill the places the article's circuit does not integrate: no spool 1, supply and return pressure of the valve."""
    state[4] = 0.0
    state[6] = 0.0
    state[8] = prm["supply_pressure_pa"]
    _, _, state[9] = paper_flows(prm, state[2], state[3], cbv_conductance(prm, state[5]), valve_command)
