"""The one thing the loop calls: one axis through one period with its inputs held, whatever its circuit and engine."""

import math

from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.plant.handover import advance_with_handover
from hilrunner.plant.initial import initial_state
from hilrunner.plant.load import load_force_n
from hilrunner.plant.model import SCRATCH_SIZE, AxisPlant, PlantModel, assemble
from hilrunner.plant.reference import advance_lift, advance_lift_lines, advance_paper
from hilrunner.plant.stability import default_substep_count, stability_limit_s

__all__ = [
    "SCRATCH_SIZE",
    "AxisPlant",
    "PlantModel",
    "advance",
    "advance_many",
    "assemble",
    "current_load_force",
    "default_substep_count",
    "initial_state",
    "stability_limit_s",
]


@entry  # cached by itself: what calls it need not compile it again
def advance(model, axis, valve_command, load_scale, period_s, state, scratch):
    """One axis through one period, inputs held.

    Args:
        model: PlantModel, read.
        axis: index.
        valve_command: -1..1, clipped; 0..1 in circuit paper.
        load_scale: factor on the static load force.
        period_s: length of the period.
        state: (10,) float64, base.state_layout, read and written.
        scratch: (SCRATCH_SIZE,) float64, written.

    Returns:
        status.FLAG_* bits, int64.
    """
    command = min(max(valve_command, -1.0), 1.0)
    if model.engine[axis] != status.ENGINE_REFERENCE:
        flags = advance_with_handover(model, axis, command, load_scale, period_s, state, scratch)
    else:
        flags = advance_reference(model, axis, command, load_scale, period_s, state)
    return flags | state_flags(model.parameters[axis], state)


@entry  # cached by itself: what calls it need not compile it again
def advance_reference(model, axis, valve_command, load_scale, period_s, state):
    """`advance` with the first-principle model, whatever the axis' engine; returns solver flags."""
    prm = model.parameters[axis]
    load = model.load[axis]
    count = model.substep_count[axis]
    circuit = model.circuit[axis]
    flags = 0
    if circuit == status.CIRCUIT_LIFT:
        flags = advance_lift(prm, load, load_scale, valve_command, period_s, count, model.fast[axis], state)
    elif circuit == status.CIRCUIT_LIFT_LINES:
        advance_lift_lines(prm, load, load_scale, valve_command, period_s, count, state)
    else:
        advance_paper(prm, load, load_scale, valve_command, period_s, count, model.fast[axis], state)
    return flags


@hot
def state_flags(prm, state):
    """What the state itself tells: end stop touched, cavitation, not finite; status.FLAG_* bits."""
    flags = 0
    if state[0] < 0.0 or state[0] > prm["stroke_m"]:
        flags |= status.FLAG_END_STOP
    if state[2] < prm["cavitation_pressure_pa"] or state[3] < prm["cavitation_pressure_pa"]:
        flags |= status.FLAG_CAVITATION
    total = state[0] + state[1] + state[2] + state[3] + state[4]
    total += state[5] + state[6] + state[7] + state[8] + state[9]
    if not math.isfinite(total):
        flags |= status.FLAG_NOT_FINITE
    return flags


@hot
def current_load_force(model, axis, position_m, load_scale):
    """Force of the load on the rod at a position, positive against extension; N."""
    return load_scale * load_force_n(model.load[axis], position_m)


@entry
def advance_many(model, axis, valve_commands, load_scales, period_s, state, scratch, states_out, flags_out):
    """`advance` over n periods, offline.

    Args:
        valve_commands, load_scales: (n,) float64, held one period each.
        state: (10,) float64, start; ends as the last row.
        states_out: (n, 10) float64, state at the end of each period; flags_out: (n,) int64.

    Returns:
        OR of all flags. Stops at a state that is not finite; rows after it are not written.
    """
    seen = 0
    for i in range(valve_commands.shape[0]):
        flags = advance(model, axis, valve_commands[i], load_scales[i], period_s, state, scratch)
        seen |= flags
        flags_out[i] = flags
        for k in range(10):
            states_out[i, k] = state[k]
        if flags & status.FLAG_NOT_FINITE:
            break
    return seen
