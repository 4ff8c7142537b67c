"""Where in its networks' training range a surrogate was at every tick, and where its error was largest."""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.plant.line import valve_conductances
from hilrunner.plant.model import AxisPlant
from hilrunner.plant.network import FORM_PINNED, FORM_SHARE
from hilrunner.plant.spool import cbv_conductance
from hilrunner.plant.surrogate import X_AT, flow_inputs, plain_flow_inputs, return_inputs, supply_inputs

BINS = 40
_CENTRE = 0.05  # |command| below which lift's lines are solved exactly, without networks


@dataclass(frozen=True)
class InputPlace:
    """One input of one network over a run: its range, where the worst error sat, and the worst error along the range."""

    network: str
    name: str
    low: float
    high: float
    at_worst: float
    bin_edges: np.ndarray  # float64[BINS + 1], from low to high
    worst_in_bin: np.ndarray  # float64[BINS], unit of the error; NaN: never there

    @property
    def share_at_worst(self) -> float:
        """Where in the range: 0 at its low end, 1 at its high end, beyond when outside."""
        return (self.at_worst - self.low) / (self.high - self.low)


def places_in_range(plant: AxisPlant, states: np.ndarray, commands: np.ndarray, error: np.ndarray) -> list[InputPlace]:
    """Along every input of every network of an axis.

    Args:
        plant: with networks; without, nothing is returned.
        states: float64[n, 10], the state each period began with. commands: float64[n]. error: float64[n], size of the error
            each period added.
    """
    if plant.networks is None or not len(states):
        return []
    inputs = (
        _lift_inputs(plant, states, commands)
        if plant.circuit != status.CIRCUIT_PAPER
        else _paper_inputs(plant, states, commands)
    )
    finite = np.where(np.isfinite(error), error, -1.0)
    places = []
    for role, mlp in plant.networks.networks.items():
        values = inputs.get(role)
        if values is None or values.shape[1] != mlp.input_count or not np.isfinite(values).all(axis=1).any():
            continue
        used = np.isfinite(values).all(axis=1)
        worst = int(np.argmax(np.where(used, finite, -1.0)))
        names = mlp.input_names or tuple(f"input {k + 1}" for k in range(mlp.input_count))
        for k, name in enumerate(names):
            low, high = float(mlp.input_low[k]), float(mlp.input_high[k])
            edges, largest = _along(values[used, k], finite[used], low, high)
            places.append(InputPlace(role, name, low, high, float(values[worst, k]), edges, largest))
    return places


def _along(values: np.ndarray, error: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Largest error in each of BINS equal parts of the range; values outside are left out."""
    edges = np.linspace(low, high, BINS + 1)
    inside = (values >= low) & (values <= high)
    part = np.minimum(((values[inside] - low) / (high - low) * BINS).astype(np.int64), BINS - 1)
    largest = np.full(BINS, -1.0)
    np.maximum.at(largest, part, error[inside])
    return edges, np.where(largest >= 0, largest, np.nan)


def _lift_inputs(plant: AxisPlant, states: np.ndarray, commands: np.ndarray) -> dict[str, np.ndarray]:
    supply, returned = np.full((len(states), 3), np.nan), np.full((len(states), 2), np.nan)
    _lift_inputs_many(plant.parameters, states, commands, supply, returned)
    return {"supply": supply, "return": returned}


@entry
def _lift_inputs_many(parameters, states, commands, supply, returned):
    """Inputs of both branch networks (plant.surrogate) at n states; rows near the valve's centre are left as they are."""
    prm = parameters[0]
    work = np.zeros(32)
    for i in range(states.shape[0]):
        command = commands[i]
        if abs(command) < _CENTRE:
            continue
        pa, at, pb, bt = valve_conductances(prm, command)
        bore, rod = states[i, 2], states[i, 3]
        cbv_bore, cbv_rod = cbv_conductance(prm, states[i, 4]), cbv_conductance(prm, states[i, 5])
        if command > 0.0:
            supply_inputs(prm, bore, cbv_bore, pa, work, 0)
        else:
            supply_inputs(prm, rod, cbv_rod, pb, work, 0)
        for k in range(3):
            supply[i, k] = work[k]
        if command > 0.0:
            return_inputs(prm, rod, cbv_rod, bt, work, 0)
        else:
            return_inputs(prm, bore, cbv_bore, at, work, 0)
        for k in range(2):
            returned[i, k] = work[k]


def _paper_inputs(plant: AxisPlant, states: np.ndarray, commands: np.ndarray) -> dict[str, np.ndarray]:
    """Inputs of the one network of the article's circuit, in the quantities its recipe and form ask for (plant.surrogate)."""
    command = np.maximum(commands, 0.0)
    found = {"rates": np.column_stack((states[:, :4], command))}
    mlp = plant.networks.networks.get("flow")
    if mlp is not None:
        flow = np.full((len(states), 4), np.nan)
        _flow_inputs_many(plant.parameters, np.ascontiguousarray(states), command, mlp.form, flow)
        found["flow"] = flow[:, : mlp.input_count]
    return found


@entry
def _flow_inputs_many(parameters, states, commands, form, flow):
    """Inputs of the flow network at n states; rows at which the network is not asked are left as they are."""
    prm = parameters[0]
    work = np.zeros(32)
    for i in range(states.shape[0]):
        cbv_si = cbv_conductance(prm, states[i, 5])
        if commands[i] <= 0.0 or (form == FORM_PINNED and cbv_si != prm["cbv_si"]):
            continue
        if form == FORM_SHARE:
            flow_inputs(prm, states[i, 2], states[i, 3], cbv_si, commands[i], work)
        else:
            plain_flow_inputs(prm, states[i, 2], states[i, 3], cbv_si, commands[i], work)
        for k in range(4):
            flow[i, k] = work[X_AT + k]
