"""The surrogate's periods, and those it hands over to the exact engine because its reduced model does not hold there.

The surrogate leaves out the mass of the spools. That costs next to nothing while a spool follows its forces, and nearly all of the
surrogate's error where one is thrown about: at a step of the command, at a valve that cracks, and above all under a command that
chatters (0 to 40 % every few milliseconds put a healthy `amc-lift` 0.08 MPa off). At a stroke end the chambers are small and
stiff, so that the same error weighs many times as much. A period of that kind is taken by the exact engine from the same
state, in steps as fine as those of the reference that judges the run. It costs no more than the networks would.

Handed over is a period
- that starts within END_MARGIN_M of a stroke end, or with an oil column so short that STIFF_COLUMN_PAPM is exceeded: 1 um of oil that a
  closing spool lets through more or less is then 7 kPa that stay until the valve opens again;
- that starts or ends with a chamber less than RETURN_LOW_PA above the tank: networks are not used there, valves that open and oil that
  softens ask for finer steps, and cavitation begins below;
- at whose start, with the period's own command, the speed of a spool without mass differs from the speed the spool has;
- over which the speed of a spool changed by more than that.
What the networks had computed of a period that ends so is thrown away.
"""

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.base.state_layout import STATE_SIZE
from hilrunner.plant import network
from hilrunner.plant.line import valve_conductances
from hilrunner.plant.mechanics import chamber_volumes
from hilrunner.plant.rates_lift import exact_lines_at, start_lines
from hilrunner.plant.reference import advance_lift, advance_paper
from hilrunner.plant.spool import mass_free_spool_speed, opening_force
from hilrunner.plant.surrogate import RETURN_LOW_PA, advance_surrogate

# A spool without mass is ahead of one with mass by the change of speed times their time constant, 0.25 ms at most for the presets:
# 0.75 um of 4 mm. docs/plant.md has what larger and smaller values cost and give.
SPOOL_SPEED_CHANGE_MPS = 0.003
END_MARGIN_M = 0.02
END_MARGIN_SHARE = 0.1  # of the stroke, for short cylinders
STIFF_COLUMN_PAPM = 7e9  # bulk modulus over length of the oil column: 10 cm of it for the presets
KEPT_AT = 64  # place in scratch of the ten states before the period


@hot
def _near_a_stroke_end(prm, position_m):
    margin = min(END_MARGIN_M, END_MARGIN_SHARE * prm["stroke_m"])
    volume_1, volume_2 = chamber_volumes(prm, position_m)
    shortest_m = min(volume_1 / prm["bore_area_m2"], volume_2 / prm["rod_side_area_m2"])
    short = prm["bulk_modulus_pa"] > STIFF_COLUMN_PAPM * shortest_m
    return short or position_m < margin or position_m > prm["stroke_m"] - margin


@hot
def _chamber_nearly_empty(prm, state):
    return min(state[2], state[3]) < prm["tank_pressure_pa"] + RETURN_LOW_PA


@hot
def _spool_jumped(state, scratch):
    """Whether a spool's speed changed over the period; scratch holds the state at its start."""
    change_1, change_2 = abs(state[6] - scratch[KEPT_AT + 6]), abs(state[7] - scratch[KEPT_AT + 7])
    return max(change_1, change_2) > SPOOL_SPEED_CHANGE_MPS


@hot
def _spool_about_to_jump(prm, circuit, valve_command, load, load_scale, state):
    """Whether a spool without mass would leave at another speed than the one it arrived with."""
    if circuit == status.CIRCUIT_LIFT:
        context = (prm, load, load_scale, valve_conductances(prm, valve_command), 0)
        lines, _, _ = exact_lines_at(context, state[2], state[3], state[4], state[5], start_lines(state))
        force_1 = opening_force(prm, lines[1], state[2], lines[0], prm["setting_1_pa"])
        force_2 = opening_force(prm, lines[0], state[3], lines[1], prm["setting_2_pa"])
        if abs(mass_free_spool_speed(prm, force_1, state[4]) - state[6]) > SPOOL_SPEED_CHANGE_MPS:
            return True
    else:
        force_2 = opening_force(prm, state[2], state[3], 0.0, prm["setting_2_pa"])
    return abs(mass_free_spool_speed(prm, force_2, state[5]) - state[7]) > SPOOL_SPEED_CHANGE_MPS


@hot
def _advance_exact(model, axis, valve_command, load, load_scale, period_s, state):
    """The period by the full first-principle model; returns its flags with FLAG_EXACT_STEP."""
    prm = model.parameters[axis]
    count = model.exact_substep_count[axis]
    flags = status.FLAG_EXACT_STEP
    if model.circuit[axis] == status.CIRCUIT_LIFT:
        flags |= advance_lift(prm, load, load_scale, valve_command, period_s, count, False, state)
    else:
        advance_paper(prm, load, load_scale, valve_command, period_s, count, False, state)
    return flags


@entry  # cached by itself: what calls it need not compile it again
def advance_with_handover(model, axis, valve_command, load_scale, period_s, state, scratch):
    """One axis through one period with its networks, or by the exact engine; arguments and result as plant.step.advance.

    An axis whose `exact_substep_count` is 0 never hands over; nor does the article's own form of network (recipe paper).
    `scratch` holds the state before the period from KEPT_AT on.
    """
    if model.exact_substep_count[axis] == 0 or model.network.axis_recipe[axis] == network.RECIPE_PAPER:
        return advance_surrogate(model, axis, valve_command, load_scale, period_s, state, scratch)
    prm = model.parameters[axis]
    load = model.load[axis]
    exact = _near_a_stroke_end(prm, state[0]) or _chamber_nearly_empty(prm, state)
    if not exact and not _spool_about_to_jump(prm, model.circuit[axis], valve_command, load, load_scale, state):
        for k in range(STATE_SIZE):
            scratch[KEPT_AT + k] = state[k]
        flags = advance_surrogate(model, axis, valve_command, load_scale, period_s, state, scratch)
        if not _spool_jumped(state, scratch) and not _chamber_nearly_empty(prm, state):
            return flags
        for k in range(STATE_SIZE):
            state[k] = scratch[KEPT_AT + k]
    return _advance_exact(model, axis, valve_command, load, load_scale, period_s, state)
