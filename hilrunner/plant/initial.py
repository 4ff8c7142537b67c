"""States to start from: at rest under the load, or in steady motion under a held command; an error where none exists.

The inlet side fixes everything else: a rod speed asks for an inlet flow, that for a line and an inlet pressure, the force
balance for the outlet pressure, pilot and outlet pressure for the spool, and the spool for the outlet flow. What the
outlet passes minus what the rod displaces falls with speed, so its root is bracketed and bisected.
"""

import math

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.base.errors import StateError
from hilrunner.plant.hydraulics import ABSOLUTE_VACUUM_PA, inverse_orifice_root
from hilrunner.plant.line import chamber_side_flow, solve_line, valve_conductances, valve_side_flow
from hilrunner.plant.load import LoadTable, load_force_n
from hilrunner.plant.rates_paper import paper_flows
from hilrunner.plant.spool import cbv_conductance, opening_force

_BISECTIONS = 200
_PASSES = 30

FOUND = 0
NO_HOLD = 1  # a counterbalance valve would open under the load alone
NO_PRESSURE = 2  # a chamber would have to be below absolute vacuum
NO_SPEED = 3  # the outlet cannot pass what the rod would displace at any speed


@hot
def resting_spool_m(prm, force_n):
    """Where a spool rests under an opening force: on its spring, or as deep in an elastic stop as the force presses it."""
    spring = prm["spool_spring_npm"]
    position = force_n / spring
    stop = prm["spool_stop_stiffness_npm"]
    if position < 0.0:
        return force_n / (spring + stop)
    if position > prm["spool_stroke_m"]:
        return (force_n + stop * prm["spool_stroke_m"]) / (spring + stop)
    return position


@hot
def _inlet(prm, flow, supply_si, return_si, cbv_si):
    """Line and chamber pressure on the inlet side that pass a flow >= 0 into the chamber."""
    low, high = prm["tank_pressure_pa"] - 1e6, prm["supply_pressure_pa"] + 1e6
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        passed, _ = valve_side_flow(prm, middle, supply_si, return_si)
        if passed > flow:
            low = middle
        else:
            high = middle
    line = 0.5 * (low + high)
    low, high = line - 4e7, line
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        passed, _ = chamber_side_flow(prm, line, middle, cbv_si)
        if passed > flow:
            low = middle
        else:
            high = middle
    return line, 0.5 * (low + high)


@hot
def _outlet(prm, pilot_pa, chamber_pa, setting_pa, supply_si, return_si):
    """Resting spool, line pressure and outflow of the outlet side; the spool may feel its own line (back pressure)."""
    low, high = -0.1, 0.1
    line, flow, spool = prm["tank_pressure_pa"], 0.0, 0.0
    for _ in range(_BISECTIONS):
        spool = 0.5 * (low + high)
        line, flow, _, _ = solve_line(prm, chamber_pa, cbv_conductance(prm, spool), supply_si, return_si, line)
        if resting_spool_m(prm, opening_force(prm, pilot_pa, chamber_pa, line, setting_pa)) > spool:
            low = spool
        else:
            high = spool
    return spool, line, -flow


@hot
def _steady_lift(prm, load_n, valve_command, state):
    """Fill v, p1, p2, spools and lines of `lift` for a command; returns FOUND or a reason."""
    conductances = valve_conductances(prm, valve_command)
    up = valve_command >= 0.0
    if up:
        supply_in, return_in, supply_out, return_out = conductances
        area_in, area_out, sign = prm["bore_area_m2"], prm["rod_side_area_m2"], 1.0
        setting_in, setting_out = prm["setting_1_pa"], prm["setting_2_pa"]
    else:
        supply_out, return_out, supply_in, return_in = conductances
        area_in, area_out, sign = prm["rod_side_area_m2"], prm["bore_area_m2"], -1.0
        setting_in, setting_out = prm["setting_2_pa"], prm["setting_1_pa"]
    cbv_in = 0.0
    spool_in = 0.0
    fastest = supply_in * math.sqrt(prm["supply_pressure_pa"]) / area_in
    low = 0.0
    line_in, p_in, p_out, spool_out, line_out = 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(_PASSES):  # the inlet spool rarely opens; where it does, it changes little
        low, high = 0.0, fastest
        for _ in range(_BISECTIONS):
            speed = 0.5 * (low + high)
            line_in, p_in = _inlet(prm, area_in * speed, supply_in, return_in, cbv_in)
            p_out = (area_in * p_in - sign * load_n - prm["viscous_friction_nspm"] * speed) / area_out
            spool_out, line_out, passed = _outlet(prm, line_in, p_out, setting_out, supply_out, return_out)
            if passed > area_out * speed:
                low = speed
            else:
                high = speed
            if not high - low > 1e-15:
                break
        force = opening_force(prm, line_out, p_in, line_in, setting_in)
        settled = abs(resting_spool_m(prm, force) - spool_in) < 1e-13
        spool_in = resting_spool_m(prm, force)
        cbv_in = cbv_conductance(prm, spool_in)
        if settled:
            break
    speed = 0.5 * (low + high)
    if speed < 1e-12:
        return NO_SPEED
    state[1] = sign * speed
    if up:
        state[2], state[3], state[4], state[5], state[8], state[9] = p_in, p_out, spool_in, spool_out, line_in, line_out
    else:
        state[2], state[3], state[4], state[5], state[8], state[9] = p_out, p_in, spool_out, spool_in, line_out, line_in
    return FOUND if min(p_in, p_out) > ABSOLUTE_VACUUM_PA else NO_PRESSURE


@hot
def _hold_pressures(prm, load_n, state):
    """p1, p2 that carry the load at rest: the unloaded chamber at its rest pressure."""
    rest = prm["rest_pressure_2_pa"]
    state[3] = rest
    state[2] = (load_n + prm["rod_side_area_m2"] * rest) / prm["bore_area_m2"]
    if state[2] < prm["tank_pressure_pa"]:  # the load pulls: chamber 2 carries it
        state[2] = prm["tank_pressure_pa"]
        state[3] = (prm["bore_area_m2"] * state[2] - load_n) / prm["rod_side_area_m2"]


@hot
def _hold_lift(prm, load_n, valve_command, state):
    """Rest of `lift`: both counterbalance valves shut, lines where the directional valve leaves them."""
    supply_a, return_a, supply_b, return_b = valve_conductances(prm, valve_command)
    _hold_pressures(prm, load_n, state)
    state[1] = 0.0
    state[8], flow_1, _, _ = solve_line(prm, state[2], 0.0, supply_a, return_a, prm["tank_pressure_pa"])
    state[9], flow_2, _, _ = solve_line(prm, state[3], 0.0, supply_b, return_b, prm["tank_pressure_pa"])
    state[4] = resting_spool_m(prm, opening_force(prm, state[9], state[2], state[8], prm["setting_1_pa"]))
    state[5] = resting_spool_m(prm, opening_force(prm, state[8], state[3], state[9], prm["setting_2_pa"]))
    if state[4] > 0.0 or state[5] > 0.0 or flow_1 != 0.0 or flow_2 != 0.0:
        return NO_HOLD
    return FOUND


@hot
def _paper_state(prm, load_n, valve_command, state):
    """Rest (command 0) or steady lifting of the article's circuit."""
    area_1, area_2 = prm["bore_area_m2"], prm["rod_side_area_m2"]
    state[1] = 0.0
    if valve_command > 0.0:
        supply = prm["valve_pa_si"] * valve_command
        low, high = 0.0, supply * math.sqrt(prm["supply_pressure_pa"] + 4e7) / area_1
        for _ in range(_BISECTIONS):
            speed = 0.5 * (low + high)
            drop = inverse_orifice_root(area_1 * speed / supply, prm["transition_pressure_pa"])
            state[2] = prm["supply_pressure_pa"] - drop
            state[3] = (area_1 * state[2] - load_n - prm["viscous_friction_nspm"] * speed) / area_2
            state[5] = resting_spool_m(prm, opening_force(prm, state[2], state[3], 0.0, prm["setting_2_pa"]))
            _, passed, _ = paper_flows(prm, state[2], state[3], cbv_conductance(prm, state[5]), valve_command)
            if -passed > area_2 * speed:
                low = speed
            else:
                high = speed
        state[1] = 0.5 * (low + high)
        if state[1] < 1e-12:
            return NO_SPEED
    else:
        _hold_pressures(prm, load_n, state)
        state[5] = resting_spool_m(prm, opening_force(prm, state[2], state[3], 0.0, prm["setting_2_pa"]))
    state[8] = prm["supply_pressure_pa"]
    _, _, state[9] = paper_flows(prm, state[2], state[3], cbv_conductance(prm, state[5]), valve_command)
    return FOUND if min(state[2], state[3]) > ABSOLUTE_VACUUM_PA else NO_PRESSURE


@entry
def _find(parameters, circuit, load_n, valve_command, state):
    prm = parameters[0]
    if circuit == status.CIRCUIT_PAPER:
        return _paper_state(prm, load_n, max(valve_command, 0.0), state)
    code = _hold_lift(prm, load_n, valve_command, state)
    if code == NO_HOLD and valve_command != 0.0:
        code = _steady_lift(prm, load_n, valve_command, state)
    return code


@entry
def _force_at(loads, x_m):
    return load_force_n(loads[0], x_m)


def static_load_n(load: LoadTable, x_m: float) -> float:
    """F_L(x), for cold code; N."""
    return float(_force_at(load.record(), x_m))


def initial_state(axis_plant, rod_position_m: float, valve_command: float = 0.0, load_scale: float = 1.0) -> np.ndarray:
    """A consistent state at rest (valve neutral) or in steady motion under a held command.

    Args:
        axis_plant: plant.model.AxisPlant.
        rod_position_m: inside the stroke.
        valve_command: -1..1 (0..1 in circuit paper).
        load_scale: factor on the static load.

    Returns:
        (10,) float64, base.state_layout.

    Raises:
        StateError: position outside the stroke, command outside its range, or no such state under this load.
    """
    prm = axis_plant.parameters[0]
    place = f"initial state at {rod_position_m * 1e3:g} mm, command {valve_command:g}"
    if not 0.0 <= rod_position_m <= prm["stroke_m"]:
        raise StateError(place, "the rod is not inside its stroke", f"0 to {prm['stroke_m'] * 1e3:g} mm")
    lowest = 0.0 if axis_plant.circuit == status.CIRCUIT_PAPER else -1.0
    if not lowest <= valve_command <= 1.0:
        raise StateError(place, "the command is out of range", f"{lowest:g} to 1")
    load_n = static_load_n(axis_plant.load, rod_position_m) * load_scale
    state = np.zeros(10)
    code = _find(axis_plant.parameters, axis_plant.circuit, load_n, float(valve_command), state)
    state[0] = rod_position_m
    if code != FOUND:
        raise StateError(place, *_reason(code, prm, load_n, state))
    return state


def _reason(code: int, prm, load_n: float, state: np.ndarray) -> tuple[str, str, str]:
    load = f"a load of {load_n / 1e3:.1f} kN"
    pressures = f"chambers at {state[2] / 1e6:.2f} and {state[3] / 1e6:.2f} MPa"
    if code == NO_HOLD:
        limits = f"settings {prm['setting_1_pa'] / 1e6:g} and {prm['setting_2_pa'] / 1e6:g} MPa less the pilots"
        return (
            f"{load} ({pressures}) opens a counterbalance valve: no state of rest",
            limits,
            "lower the load or raise the setting",
        )
    if code == NO_PRESSURE:
        return (
            f"{load} would need {pressures}: below absolute vacuum",
            "above -0.101 MPa gauge",
            "less command, or a valve that lets less out than the pump brings in",
        )
    return f"{load} does not move: the outlet stays shut or the pump cannot lift it", "", "another command or load"
