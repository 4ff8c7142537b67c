"""The algebraic pressure between directional valve and counterbalance block: one scalar balance a line, always solved.

Convention: every orifice has its own drop and its own laminar-turbulent transition ("phi per orifice"), in the residual,
in the elimination and in what a surrogate learns. Flows are positive from the valve towards the chamber.

    f(p_l) = K_P phi(p_s - p_l) - K_T phi(p_l - p_t) + anti-cavitation(p_l) - relief(p_l)        valve side
             - [K_ck open(p_l - p) + K_c] phi(p_l - p) = 0                                       chamber side

f falls strictly in p_l and its root lies between min(p_t, p) and max(p_s, p): Newton inside that bracket, bisection when
a step leaves it.
"""

from hilrunner.base.compiled import inlined
from hilrunner.plant.hydraulics import orifice_root_and_slope, smoothstep, smoothstep_slope

# A Newton step this small is taken and ends the search; pressure and flow follow it to first order, so what is left is
# its square over the nearest pressure drop: below 0.02 Pa at 10 kPa, where the orifice law bends most.
STEP_TOLERANCE_PA = 20.0
ITERATION_LIMIT = 80  # bisection alone narrows 30 MPa to a rounding error in 80


@inlined
def valve_side_flow(prm, line_pa, supply_si, return_si):
    """Flow from the directional valve, anti-cavitation and relief valve into a line, and its slope; m^3/s, m^3/(s Pa)."""
    transition = prm["transition_pressure_pa"]
    flow = 0.0
    slope = 0.0
    if supply_si > 0.0:
        root, root_slope = orifice_root_and_slope(prm["supply_pressure_pa"] - line_pa, transition)
        flow += supply_si * root
        slope -= supply_si * root_slope
    over_tank = line_pa - prm["tank_pressure_pa"]
    if return_si > 0.0:
        root, root_slope = orifice_root_and_slope(over_tank, transition)
        flow -= return_si * root
        slope -= return_si * root_slope
    share = (-over_tank - prm["anticavitation_crack_pa"]) / prm["anticavitation_range_pa"]
    if share > 0.0:
        root, root_slope = orifice_root_and_slope(-over_tank, transition)
        opening = prm["anticavitation_si"] * smoothstep(share)
        flow += opening * root
        slope -= opening * root_slope
        slope -= prm["anticavitation_si"] * smoothstep_slope(share) / prm["anticavitation_range_pa"] * root
    if line_pa > prm["relief_pressure_pa"]:
        flow -= prm["relief_m3pspa"] * (line_pa - prm["relief_pressure_pa"])
        slope -= prm["relief_m3pspa"]
    return flow, slope


@inlined
def chamber_side_flow(prm, line_pa, chamber_pa, cbv_si):
    """Flow from a line into its chamber through check valve and counterbalance spool, and its slope over the line pressure."""
    drop = line_pa - chamber_pa
    opening = cbv_si
    opening_slope = 0.0
    share = (drop - prm["check_crack_pa"]) / prm["check_range_pa"]
    if share > 0.0:
        opening += prm["check_si"] * smoothstep(share)
        opening_slope = prm["check_si"] * smoothstep_slope(share) / prm["check_range_pa"]
    if opening == 0.0:
        return 0.0, 0.0
    root, root_slope = orifice_root_and_slope(drop, prm["transition_pressure_pa"])
    return opening * root, opening * root_slope + opening_slope * root


@inlined
def line_balance(prm, line_pa, chamber_pa, cbv_si, supply_si, return_si):
    """Flow gathering in a line of no volume: zero at the line's pressure; m^3/s."""
    into, _ = valve_side_flow(prm, line_pa, supply_si, return_si)
    out, _ = chamber_side_flow(prm, line_pa, chamber_pa, cbv_si)
    return into - out


@inlined
def solve_line(prm, chamber_pa, cbv_si, supply_si, return_si, guess_pa):
    """Pressure of a line and the flow it sends into its chamber.

    Args:
        prm: one PARAMETERS record.
        chamber_pa: pressure of the chamber behind the counterbalance valve.
        cbv_si: conductance of the counterbalance spool, k_qc a_c(x_c), m^3/(s sqrt(Pa)).
        supply_si, return_si: conductances of the edges to pump and tank; at least one positive.
        guess_pa: where to start, any number.

    Returns:
        (line pressure Pa, flow into the chamber m^3/s, iterations, d line / d chamber pressure);
        iterations > ITERATION_LIMIT: stopped, not converged.
    """
    tank = prm["tank_pressure_pa"]
    if supply_si == 0.0 and cbv_si == 0.0 and tank - chamber_pa <= prm["check_crack_pa"]:
        return tank, 0.0, 0, 0.0  # shut towards the chamber: exactly no flow
    low = min(tank, chamber_pa)
    high = max(prm["supply_pressure_pa"] if supply_si > 0.0 else tank, chamber_pa)
    line = guess_pa if low <= guess_pa <= high else 0.5 * (low + high)
    before = high - low
    for iteration in range(ITERATION_LIMIT):
        into, into_slope = valve_side_flow(prm, line, supply_si, return_si)
        out, out_slope = chamber_side_flow(prm, line, chamber_pa, cbv_si)
        excess = into - out
        slope = out_slope - into_slope
        step = excess / slope if slope > 0.0 else high - low
        if abs(step) <= STEP_TOLERANCE_PA:
            return line + step, out + out_slope * step, iteration + 1, out_slope / slope
        if excess > 0.0:
            low = line
        else:
            high = line
        following = line + step
        # around an odd root Newton can swing from side to side for ever: steps must halve, or the bracket is halved
        if not (low < following < high) or abs(step) > 0.5 * before:
            following = 0.5 * (low + high)
            if following == low or following == high:
                return following, out, iteration + 1, 0.0  # nothing left between the two
        before = abs(following - line)
        line = following
    return line, chamber_side_flow(prm, line, chamber_pa, cbv_si)[0], ITERATION_LIMIT + 1, 0.0


@inlined
def solve_supply_line(context, prm, chamber_pa, cbv_si, valve_si, guess_pa):
    """The line towards the pump, no edge to tank: (pressure, flow into the chamber, iterations). `context` is not used."""
    line, flow, iterations, _ = solve_line(prm, chamber_pa, cbv_si, valve_si, 0.0, guess_pa)
    return line, flow, iterations


@inlined
def solve_return_line(context, prm, chamber_pa, cbv_si, valve_si, guess_pa):
    """The line towards the tank, no edge to the pump: (pressure, flow into the chamber, iterations). `context` unused."""
    line, flow, iterations, _ = solve_line(prm, chamber_pa, cbv_si, 0.0, valve_si, guess_pa)
    return line, flow, iterations


@inlined
def valve_conductances(prm, valve_command):
    """Conductances (P->A, A->T, P->B, B->T) of the directional valve at a command of -1..1; m^3/(s sqrt(Pa))."""
    size = abs(valve_command)
    bleed = prm["bleed_si"] * smoothstep(1.0 - size / prm["bleed_range"])
    if valve_command >= 0.0:
        return prm["valve_pa_si"] * size, bleed, 0.0, prm["valve_bt_si"] * size + bleed
    return 0.0, prm["valve_at_si"] * size + bleed, prm["valve_pb_si"] * size, bleed
