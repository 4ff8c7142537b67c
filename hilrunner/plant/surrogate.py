"""The reduced models around the networks: volumes, mechanics, spools and the sign of the command stay analytic.

Circuit `lift`, recipe flow: x, v, p1, p2 and both spools (without mass) are states; two networks, one a branch, give
what otherwise needs a Newton solve in every stage: the pressure of the line towards the pump and the flow through the
line towards the tank. Their inputs are ratios, so they hold for any valve size, area, mass and load.

Circuit `paper`, recipe flow: networks give the valve flows per unit command. With the spool pressed on its open stop
(the whole of the article's experiment) it follows its force balance and four states are left; elsewhere it is a fifth.

Circuit `paper`, recipe paper: the article's own form, one network from (x, v, p1, p2, u) to both pressure rates.

What stays exact, so that nothing drifts: no flow at command 0, no flow through a shut counterbalance valve, and the
exact line solve near the valve's centre, below tank pressure and outside the range a network was trained on (flagged).
"""

import math

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot, inlined
from hilrunner.plant import network
from hilrunner.plant.hydraulics import inverse_orifice_root, orifice_root
from hilrunner.plant.line import ITERATION_LIMIT, solve_return_line, solve_supply_line, valve_conductances
from hilrunner.plant.mechanics import chambers_above_vacuum, pressure_rates, rod_acceleration
from hilrunner.plant.network import forward_at, outside_training
from hilrunner.plant.rates_lift import make_lines, make_mass_free_rates, start_lines
from hilrunner.plant.rates_paper import paper_flows
from hilrunner.plant.reference import store_mass_free_lift, store_paper_lines
from hilrunner.plant.rk4 import make_rk4
from hilrunner.plant.spool import cbv_conductance, mass_free_spool_speed, opening_force

# places of the scratch array
X_AT = 0
Y_AT = 8
OUTSIDE_AT = 16  # not 0: a network was asked outside its training range in this period
SERVED_AT = 17  # evaluations served by networks, counted up over all periods
EXACT_AT = 18  # evaluations served by the exact functions although a network exists
PAIR_X_AT = 24  # a second network's inputs and outputs
PAIR_Y_AT = 32

# definition of the flow recipe's inputs (part of the recipe, written into every model file)
SHARE_ROOT = math.sqrt(1e5)  # sqrt(Pa): pressure root at which spool and check valve weigh the same
RETURN_LOW_PA = 0.1e6  # below this over tank the return branch is solved exactly: check and anti-cavitation valves meet
PINNED_MARGIN_N = 50.0  # force left on the open stop for a spool to count as resting there


@inlined
def supply_inputs(prm, chamber_pa, cbv_si, valve_si, work, at):
    """Inputs of the supply network into work[at:]: fourth root of the demand, share of the open spool, drop to the chamber.

    demand = K/K_ck phi(p_s - p), sqrt(Pa); share = K_c r / (K_c r + K_ck demand), 0..1, r = SHARE_ROOT; drop in Pa.
    """
    drop = prm["supply_pressure_pa"] - chamber_pa
    demand = valve_si / prm["check_si"] * orifice_root(drop, prm["transition_pressure_pa"])
    weighed = cbv_si * SHARE_ROOT
    work[at] = math.sqrt(max(demand, 0.0))
    work[at + 1] = weighed / (weighed + prm["check_si"] * demand)
    work[at + 2] = drop


@inlined
def return_inputs(prm, chamber_pa, cbv_si, valve_si, work, at):
    """Inputs of the return network into work[at:]: pressure root over tank, sqrt(Pa), the spool's share K_c / (K_c + K), 0..1."""
    work[at] = orifice_root(chamber_pa - prm["tank_pressure_pa"], prm["transition_pressure_pa"])
    work[at + 1] = cbv_si / (cbv_si + valve_si)


@inlined
def supply_result(prm, chamber_pa, valve_si, over_pa):
    """(line pressure, flow into the chamber) from what the supply network gives: the line's pressure over the chamber's."""
    line = chamber_pa + over_pa
    return line, valve_si * orifice_root(prm["supply_pressure_pa"] - line, prm["transition_pressure_pa"])


@inlined
def return_result(prm, chamber_root, valve_si, ratio):
    """(line pressure, flow into the chamber) from what the return network gives: the line's root over the chamber's."""
    root = chamber_root * ratio
    drop = inverse_orifice_root(root, prm["transition_pressure_pa"])
    return prm["tank_pressure_pa"] + drop, -valve_si * root


@hot
def supply_line_by_network(context, prm, chamber_pa, cbv_si, valve_si, guess_pa):
    """A branch function of plant.rates_lift.make_lines: the line towards the pump."""
    words, supply_at, _, work = context
    if chamber_pa >= prm["tank_pressure_pa"]:
        supply_inputs(prm, chamber_pa, cbv_si, valve_si, work, X_AT)
        if not outside_training(words, supply_at, work, X_AT):
            forward_at(words, supply_at, work, X_AT, Y_AT)
            work[SERVED_AT] += 1.0
            line, flow = supply_result(prm, chamber_pa, valve_si, work[Y_AT])
            return line, flow, 0
        work[OUTSIDE_AT] = 1.0
    work[EXACT_AT] += 1.0
    return solve_supply_line(0, prm, chamber_pa, cbv_si, valve_si, guess_pa)


@hot
def return_line_by_network(context, prm, chamber_pa, cbv_si, valve_si, guess_pa):
    """A branch function of plant.rates_lift.make_lines: the line towards the tank."""
    words, _, return_at, work = context
    over = chamber_pa - prm["tank_pressure_pa"]
    if over >= RETURN_LOW_PA:
        if cbv_si == 0.0:
            return prm["tank_pressure_pa"], 0.0, 0  # shut: a learned zero would let the load creep
        return_inputs(prm, chamber_pa, cbv_si, valve_si, work, X_AT)
        if not outside_training(words, return_at, work, X_AT):
            forward_at(words, return_at, work, X_AT, Y_AT)
            work[SERVED_AT] += 1.0
            line, flow = return_result(prm, work[X_AT], valve_si, work[Y_AT])
            return line, flow, 0
        work[OUTSIDE_AT] = 1.0
    work[EXACT_AT] += 1.0
    return solve_return_line(0, prm, chamber_pa, cbv_si, valve_si, guess_pa)


_lines_one_by_one = make_lines(supply_line_by_network, return_line_by_network)


@hot
def _lines_apart(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines):
    """Each line by itself: near the valve's centre, with a shut valve, where a network does not know the answer."""
    return _lines_one_by_one(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines)


@inlined
def _network_lines_at(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines):
    """Both lines of `lift`, their networks interleaved where both serve: the pump drives one line, the other drains."""
    prm, _, _, conductances, line_context = context
    supply_a, return_a, supply_b, return_b = conductances
    words, supply_at, return_at, work = line_context
    into_a = supply_a > 0.0
    supply_si, return_si = (supply_a, return_b) if into_a else (supply_b, return_a)
    other_edges_si = return_a if into_a else return_b  # of the driven line to the tank
    driven_pa, drained_pa = (pressure_1_pa, pressure_2_pa) if into_a else (pressure_2_pa, pressure_1_pa)
    driven_m, drained_m = (spool_1_m, spool_2_m) if into_a else (spool_2_m, spool_1_m)
    drained_si = cbv_conductance(prm, drained_m)
    tank = prm["tank_pressure_pa"]
    if (
        supply_si > 0.0
        and other_edges_si == 0.0
        and drained_si != 0.0
        and driven_pa >= tank
        and drained_pa - tank >= RETURN_LOW_PA
    ):
        supply_inputs(prm, driven_pa, cbv_conductance(prm, driven_m), supply_si, work, X_AT)
        return_inputs(prm, drained_pa, drained_si, return_si, work, PAIR_X_AT)
        if not (outside_training(words, supply_at, work, X_AT) or outside_training(words, return_at, work, PAIR_X_AT)):
            forward_at(words, supply_at, work, X_AT, Y_AT)
            forward_at(words, return_at, work, PAIR_X_AT, PAIR_Y_AT)
            work[SERVED_AT] += 2.0
            driven, driven_flow = supply_result(prm, driven_pa, supply_si, work[Y_AT])
            drained, drained_flow = return_result(prm, work[PAIR_X_AT], return_si, work[PAIR_Y_AT])
            line_a, line_b = (driven, drained) if into_a else (drained, driven)
            flow_1, flow_2 = (driven_flow, drained_flow) if into_a else (drained_flow, driven_flow)
            found = (line_a, line_b, lines[2], pressure_1_pa, pressure_2_pa, 0.0, 0.0, lines[7], lines[8])
            return found, flow_1, flow_2
    return _lines_apart(context, pressure_1_pa, pressure_2_pa, spool_1_m, spool_2_m, lines)


_lift = make_rk4(make_mass_free_rates(_network_lines_at), 6, chambers_above_vacuum)


@hot
def _advance_lift(model, axis, valve_command, load, load_scale, period_s, state, work):
    prm = model.parameters[axis]
    bank = model.network
    starts = bank.axis_start
    line_context = (bank.words, starts[axis, network.ROLE_SUPPLY], starts[axis, network.ROLE_RETURN], work)
    context = (prm, load, load_scale, valve_conductances(prm, valve_command), line_context)
    count = model.substep_count[axis]
    y = (state[0], state[1], state[2], state[3], state[4], state[5])
    y, lines = _lift(context, y, start_lines(state), period_s / count, count)
    lines, _, _ = _network_lines_at(context, y[2], y[3], y[4], y[5], lines)
    store_mass_free_lift(prm, y, lines[0], lines[1], state)
    return status.FLAG_SOLVER_LIMIT if lines[2] > ITERATION_LIMIT else 0


@hot
def flow_inputs(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command, work):
    """Inputs of the flow network: p1, Pa; root of p2 over tank, sqrt(Pa); the spool's share K_c / (K_c + K_T u), 0..1."""
    drain = prm["valve_bt_si"] * valve_command
    work[X_AT] = pressure_1_pa
    work[X_AT + 1] = orifice_root(pressure_2_pa - prm["tank_pressure_pa"], prm["transition_pressure_pa"])
    work[X_AT + 2] = cbv_si / (cbv_si + drain)


@hot
def plain_flow_inputs(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command, work):
    """The same in plain quantities, for networks made elsewhere: p1, p2, Pa; command; opening of the spool, 0..1."""
    work[X_AT] = pressure_1_pa
    work[X_AT + 1] = pressure_2_pa
    work[X_AT + 2] = valve_command
    work[X_AT + 3] = cbv_si / prm["cbv_si"]


@hot
def _flows_by_network(context, pressure_1_pa, pressure_2_pa, cbv_si):
    """(q_1, q_2) of the article's circuit at a command > 0: network times command, or exact outside the range."""
    prm, _, _, valve_command, words, at, form, work = context
    if form == network.FORM_SHARE:
        flow_inputs(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command, work)
    else:
        plain_flow_inputs(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command, work)
    # a network that does not know the spool's opening holds for a spool on its open stop
    blind = form == network.FORM_PINNED and cbv_si != prm["cbv_si"]
    if blind or outside_training(words, at, work, X_AT):
        work[OUTSIDE_AT] = 1.0
        work[EXACT_AT] += 1.0
        flow_1, flow_2, _ = paper_flows(prm, pressure_1_pa, pressure_2_pa, cbv_si, valve_command)
        return flow_1, flow_2
    forward_at(words, at, work, X_AT, Y_AT)
    work[SERVED_AT] += 1.0
    return valve_command * work[Y_AT], valve_command * work[Y_AT + 1]


@hot
def _pinned_rates(context, y, lines):
    """x, v, p1, p2 with the spool on its open stop."""
    prm, load, load_scale, valve_command = context[0], context[1], context[2], context[3]
    x, v, p1, p2 = y
    flow_1, flow_2 = 0.0, 0.0
    if valve_command > 0.0:
        flow_1, flow_2 = _flows_by_network(context, p1, p2, prm["cbv_si"])
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    return (v, rod_acceleration(prm, load, load_scale, x, v, p1, p2), rate_1, rate_2), lines


@hot
def _modulating_rates(context, y, lines):
    """x, v, p1, p2, x_c with the spool anywhere, without mass."""
    prm, load, load_scale, valve_command = context[0], context[1], context[2], context[3]
    x, v, p1, p2, spool = y
    flow_1, flow_2 = 0.0, 0.0
    if valve_command > 0.0:
        flow_1, flow_2 = _flows_by_network(context, p1, p2, cbv_conductance(prm, spool))
    rate_1, rate_2 = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
    force = opening_force(prm, p1, p2, 0.0, prm["setting_2_pa"])
    acceleration = rod_acceleration(prm, load, load_scale, x, v, p1, p2)
    return (v, acceleration, rate_1, rate_2, mass_free_spool_speed(prm, force, spool)), lines


@hot
def _article_rates(context, y, lines):
    """x, v, p1, p2 with both pressure rates from one network: the article's Eq. (10), extrapolating where asked to."""
    prm, load, load_scale, valve_command, words, at, _, work = context
    x, v, p1, p2 = y
    work[X_AT], work[X_AT + 1], work[X_AT + 2], work[X_AT + 3], work[X_AT + 4] = x, v, p1, p2, valve_command
    if outside_training(words, at, work, X_AT):
        work[OUTSIDE_AT] = 1.0
    forward_at(words, at, work, X_AT, Y_AT)
    work[SERVED_AT] += 1.0
    return (v, rod_acceleration(prm, load, load_scale, x, v, p1, p2), work[Y_AT], work[Y_AT + 1]), lines


_pinned = make_rk4(_pinned_rates, 4, chambers_above_vacuum)
_modulating = make_rk4(_modulating_rates, 5, chambers_above_vacuum)
_article = make_rk4(_article_rates, 4, chambers_above_vacuum)


@hot
def _force_on_stop_n(prm, pressure_1_pa, pressure_2_pa):
    """What presses the spool against its open stop; N."""
    force = opening_force(prm, pressure_1_pa, pressure_2_pa, 0.0, prm["setting_2_pa"])
    return force - prm["spool_spring_npm"] * prm["spool_stroke_m"]


@hot
def _rest_on_stop(prm, state):
    """Spool 2 as deep in its open stop as the pressures press it, at rest."""
    stiffness = prm["spool_spring_npm"] + prm["spool_stop_stiffness_npm"]
    state[5] = prm["spool_stroke_m"] + max(_force_on_stop_n(prm, state[2], state[3]), 0.0) / stiffness
    state[7] = 0.0


@hot
def _advance_paper(model, axis, valve_command, load, load_scale, period_s, state, work):
    prm = model.parameters[axis]
    words = model.network.words
    command = max(valve_command, 0.0)
    at = model.network.axis_start[axis, network.ROLE_FLOW]
    count = model.substep_count[axis]
    step_s = period_s / count
    lines = (0.0, 0.0, 0)
    context = (prm, load, load_scale, command, words, at, int(words[at + network.HEAD_FORM]), work)
    if state[5] >= prm["spool_stroke_m"] and _force_on_stop_n(prm, state[2], state[3]) > PINNED_MARGIN_N:
        y4, _ = _pinned(context, (state[0], state[1], state[2], state[3]), lines, step_s, count)
        state[0], state[1], state[2], state[3] = y4
        _rest_on_stop(prm, state)
    else:
        y5, _ = _modulating(context, (state[0], state[1], state[2], state[3], state[5]), lines, step_s, count)
        state[0], state[1], state[2], state[3], state[5] = y5
        force = opening_force(prm, state[2], state[3], 0.0, prm["setting_2_pa"])
        state[7] = mass_free_spool_speed(prm, force, state[5])
    store_paper_lines(prm, command, state)
    return 0


@hot
def _advance_article(model, axis, valve_command, load, load_scale, period_s, state, work):
    prm = model.parameters[axis]
    bank = model.network
    command = max(valve_command, 0.0)
    count = model.substep_count[axis]
    context = (prm, load, load_scale, command, bank.words, bank.axis_start[axis, network.ROLE_RATES], 0, work)
    y, _ = _article(context, (state[0], state[1], state[2], state[3]), (0.0, 0.0, 0), period_s / count, count)
    state[0], state[1], state[2], state[3] = y
    _rest_on_stop(prm, state)
    store_paper_lines(prm, command, state)
    return 0


@entry  # cached by itself: what calls it need not compile it again
def advance_surrogate(model, axis, valve_command, load_scale, period_s, state, scratch):
    """One axis through one period with its networks; arguments and result as plant.step.advance.

    `scratch` (>= 19 float64): inputs, outputs, range flag; places SERVED_AT and EXACT_AT count evaluations and are never
    reset here. An axis without networks gives FLAG_NOT_FINITE and leaves its state alone.
    """
    bank = model.network
    if bank.axis_start[axis, 0] < 0:
        return status.FLAG_NOT_FINITE
    load = model.load[axis]
    scratch[OUTSIDE_AT] = 0.0
    if model.circuit[axis] == status.CIRCUIT_LIFT:
        flags = _advance_lift(model, axis, valve_command, load, load_scale, period_s, state, scratch)
    elif bank.axis_recipe[axis] == network.RECIPE_PAPER:
        flags = _advance_article(model, axis, valve_command, load, load_scale, period_s, state, scratch)
    else:
        flags = _advance_paper(model, axis, valve_command, load, load_scale, period_s, state, scratch)
    if scratch[OUTSIDE_AT] != 0.0:
        flags |= status.FLAG_OUTSIDE_TRAINING
    return flags
