"""The recipes of the circuits: `flow` (valve flows, physics-scaled) and `paper` (pressure rates, as the article)."""

import numpy as np

from hilrunner.base import compiled, status
from hilrunner.base.errors import UsageError
from hilrunner.plant import surrogate
from hilrunner.plant.hydraulics import inverse_orifice_root, orifice_root
from hilrunner.plant.line import ITERATION_LIMIT, solve_return_line, solve_supply_line, valve_conductances
from hilrunner.plant.mechanics import pressure_rates
from hilrunner.plant.parameters import SPEC_BY_KEY
from hilrunner.plant.rates_paper import paper_flows, quasi_static_spool_m
from hilrunner.plant.spool import cbv_conductance
from hilrunner.training.problem import Problem, Quantity, Recipe

HIGHEST_PRESSURE_PA = 15e6


def make_recipe(circuit: int, name: str, parameters: np.ndarray) -> Recipe:
    """The networks to train for a circuit (status.CIRCUIT_*) and a recipe name, for one parameter record (1,).

    Raises:
        UsageError: a circuit the recipe does not cover.
    """
    problems = {
        (status.CIRCUIT_LIFT, "flow"): lambda: (_supply(parameters), _return(parameters)),
        (status.CIRCUIT_PAPER, "flow"): lambda: (_flow(parameters),),
        (status.CIRCUIT_PAPER, "paper"): lambda: (_rates(parameters),),
    }.get((circuit, name))
    if problems is None:
        raise UsageError(
            f"recipe '{name}' for circuit '{status.CIRCUIT_NAMES[circuit]}'",
            "there is no such recipe",
            "flow for paper and lift; paper for paper",
            "lift-lines has explicit valve flows: run it with --engine reference",
        )
    return Recipe(status.CIRCUIT_NAMES[circuit], name, problems())


def _values(parameters: np.ndarray, *keys: str) -> dict[str, float]:
    return {key: float(parameters[SPEC_BY_KEY[key].field][0]) / SPEC_BY_KEY[key].factor for key in keys}


# -- circuit lift: by branch ------------------------------------------------------------------------------------------


@compiled.entry
def _supply_answers(parameters, chamber_pa, valve_si, cbv_si, inputs, targets, solved):
    prm = parameters[0]
    work = np.zeros(16)
    for i in range(len(chamber_pa)):
        surrogate.supply_inputs(prm, chamber_pa[i], cbv_si[i], valve_si[i], work, 0)
        line, _, count = solve_supply_line(0, prm, chamber_pa[i], cbv_si[i], valve_si[i], chamber_pa[i] + 1e5)
        inputs[i] = work[:3]
        targets[i, 0] = line - chamber_pa[i]
        solved[i] = count <= ITERATION_LIMIT


def _supply(parameters: np.ndarray) -> Problem:
    prm = parameters[0]
    largest = max(prm["valve_pa_si"], prm["valve_pb_si"])
    smallest = prm["bleed_range"] * min(prm["valve_pa_si"], prm["valve_pb_si"])
    tank, supply = prm["tank_pressure_pa"], prm["supply_pressure_pa"]

    def answer(points: np.ndarray):
        root = np.sqrt(HIGHEST_PRESSURE_PA - tank) * points[:, 0]
        chamber = tank + root * root
        valve = (np.sqrt(smallest) + (np.sqrt(largest) - np.sqrt(smallest)) * points[:, 1]) ** 2
        # four tenths of the points with the counterbalance valve shut: where supply lines spend their life
        share = _SHARE_HIGH * np.maximum(0.0, (points[:, 2] - 0.4) / 0.6)
        demand = valve / prm["check_si"] * np.sqrt(supply - chamber)
        cbv = np.minimum(share / (1.0 - share) * prm["check_si"] * demand / surrogate.SHARE_ROOT, prm["cbv_si"])
        return _allocate(3, 1, len(points), _supply_answers, parameters, chamber, valve, cbv)

    def demand(valve_si, drop_pa):
        return float(np.sqrt(valve_si / prm["check_si"] * np.sqrt(drop_pa)))

    low = demand(smallest, supply - HIGHEST_PRESSURE_PA)
    high = demand(largest, supply - tank)
    return Problem(
        role="supply",
        inputs=(
            Quantity("demand_root", "Pa^(1/4)", low, high),
            Quantity("spool_share_ratio", "1", 0.0, _SHARE_HIGH),
            Quantity("supply_drop_pa", "Pa", supply - HIGHEST_PRESSURE_PA, supply - tank),
        ),
        outputs=(Quantity("line_over_chamber_pa", "Pa"),),
        dimensions=3,
        answer=answer,
        parameters=_values(parameters, "transition_pressure_mpa", "check_crack_mpa", "check_range_mpa")
        | _values(parameters, "supply_pressure_mpa", "tank_pressure_mpa"),
    )


_SHARE_HIGH = 0.97


@compiled.entry
def _return_answers(parameters, chamber_pa, valve_si, cbv_si, inputs, targets, solved):
    prm = parameters[0]
    work = np.zeros(16)
    for i in range(len(chamber_pa)):
        surrogate.return_inputs(prm, chamber_pa[i], cbv_si[i], valve_si[i], work, 0)
        share = cbv_si[i] * cbv_si[i] / (cbv_si[i] * cbv_si[i] + valve_si[i] * valve_si[i])
        guess = prm["tank_pressure_pa"] + share * (chamber_pa[i] - prm["tank_pressure_pa"])
        _, flow, count = solve_return_line(0, prm, chamber_pa[i], cbv_si[i], valve_si[i], guess)
        inputs[i] = work[:2]
        targets[i, 0] = -flow / (valve_si[i] * work[0])
        solved[i] = count <= ITERATION_LIMIT


@compiled.entry
def _root(drop_pa, transition_pa):
    return orifice_root(drop_pa, transition_pa)


def _smallest_return_si(prm, command: float) -> float:
    """The least a return edge opens at a command, with the centre bleed; either side."""
    return min(_conductances(prm, -command)[1], _conductances(prm, command)[3])


@compiled.entry
def _conductances(prm, command):
    return valve_conductances(prm, command)


def _return(parameters: np.ndarray) -> Problem:
    prm = parameters[0]
    valve_si = max(prm["valve_bt_si"], prm["valve_at_si"])
    low, high = surrogate.RETURN_LOW_PA, HIGHEST_PRESSURE_PA - prm["tank_pressure_pa"]
    # the answer depends on the ratio of the two conductances only: one valve size stands for all
    commands = np.linspace(0.0, 1.0, 2001)
    smallest = min(_smallest_return_si(prm, float(command)) for command in commands)
    share_high = float(prm["cbv_si"] / (prm["cbv_si"] + smallest))

    def answer(points: np.ndarray):
        over = (np.sqrt(low) + (np.sqrt(high) - np.sqrt(low)) * points[:, 0]) ** 2
        share = share_high * np.clip(0.5 - 0.5 * np.cos(np.pi * points[:, 1]), 1e-9, 1.0)
        valve = np.full(len(points), valve_si)
        chamber = prm["tank_pressure_pa"] + over
        return _allocate(2, 1, len(points), _return_answers, parameters, chamber, valve, share / (1.0 - share) * valve)

    transition = prm["transition_pressure_pa"]
    return Problem(
        role="return",
        inputs=(
            Quantity("chamber_root_sqrtpa", "Pa^(1/2)", _root(low, transition), _root(high, transition)),
            Quantity("spool_share_ratio", "1", 0.0, share_high),
        ),
        outputs=(Quantity("line_root_ratio", "1"),),
        dimensions=2,
        answer=answer,
        parameters=_values(parameters, "transition_pressure_mpa"),
    )


# -- circuit paper ----------------------------------------------------------------------------------------------------


@compiled.entry
def _flow_answers(parameters, pressure_2_pa, inputs, targets, solved):
    prm = parameters[0]
    for i in range(len(inputs)):
        # flow per unit command depends on the ratio of the two conductances only: the command is 1 everywhere
        share = min(inputs[i, 2], _SHARE_LIMIT)
        cbv = share / (1.0 - share) * prm["valve_bt_si"]
        flow_1, flow_2, _ = paper_flows(prm, inputs[i, 0], pressure_2_pa[i], cbv, 1.0)
        targets[i, 0] = flow_1
        targets[i, 1] = flow_2
        solved[i] = True


_FLOW_KEYS = (
    "supply_pressure_mpa",
    "tank_pressure_mpa",
    "transition_pressure_mpa",
    "valve_pa_mm3ps_sqrtmpa",
    "valve_bt_mm3ps_sqrtmpa",
    "cbv_mm3ps_sqrtmpa",
    "series_floor_mm3ps_sqrtmpa",
)
_CHAMBER_1_HIGH_PA = 14e6
_CHAMBER_2_PA = (-0.1e6, 4e6)  # from absolute vacuum to eight times what lifting needs
_SHARE_LIMIT = 1.0 - 1e-12  # stands for the limit of a command of 0


def _flow(parameters: np.ndarray) -> Problem:
    prm = parameters[0]
    tank, transition = prm["tank_pressure_pa"], prm["transition_pressure_pa"]
    roots = [_root(value - tank, transition) for value in _CHAMBER_2_PA]
    inputs = (
        Quantity("chamber_1_pressure_pa", "Pa", _CHAMBER_2_PA[0], _CHAMBER_1_HIGH_PA),
        Quantity("chamber_2_root_sqrtpa", "Pa^(1/2)", roots[0], roots[1]),
        Quantity("spool_share_ratio", "1", 0.0, 1.0),
    )
    low = np.array([quantity.low for quantity in inputs])
    high = np.array([quantity.high for quantity in inputs])

    def answer(points: np.ndarray):
        values = low + (high - low) * points
        chamber_2 = tank + _inverse_roots(values[:, 1], transition)
        targets, solved = np.empty((len(points), 2)), np.empty(len(points), np.bool_)
        _flow_answers(parameters, chamber_2, values, targets, solved)
        return values, targets, solved

    outputs = (
        Quantity("flow_1_per_command_m3ps", "m^3/s"),
        Quantity("flow_2_per_command_m3ps", "m^3/s"),
    )
    return Problem("flow", inputs, outputs, 3, answer, _values(parameters, *_FLOW_KEYS))


@compiled.entry
def _inverse_roots(roots, transition_pa):
    out = np.empty(len(roots))
    for i in range(len(roots)):
        out[i] = inverse_orifice_root(roots[i], transition_pa)
    return out


@compiled.entry
def _rate_answers(parameters, inputs, targets, solved):
    prm = parameters[0]
    for i in range(len(inputs)):
        x, v, p1, p2, u = inputs[i]
        cbv = cbv_conductance(prm, quasi_static_spool_m(prm, p1, p2))
        flow_1, flow_2, _ = paper_flows(prm, p1, p2, cbv, u)
        targets[i, 0], targets[i, 1] = pressure_rates(prm, x, v, p1, p2, flow_1, flow_2)
        solved[i] = True


def _rates(parameters: np.ndarray) -> Problem:
    prm = parameters[0]
    inputs = (  # the article's Table 2; it gives no range for u
        Quantity("rod_position_m", "m", 0.0, float(prm["stroke_m"])),
        Quantity("rod_velocity_mps", "m/s", -1.0, 1.0),
        Quantity("chamber_1_pressure_pa", "Pa", 7.5e6, 9.5e6),
        Quantity("chamber_2_pressure_pa", "Pa", -1e6, 1e6),
        Quantity("valve_command_ratio", "1", 0.0, 1.0),
    )
    low = np.array([quantity.low for quantity in inputs])
    high = np.array([quantity.high for quantity in inputs])

    def answer(points: np.ndarray):
        values = low + (high - low) * points
        targets, solved = np.empty((len(points), 2)), np.empty(len(points), np.bool_)
        _rate_answers(parameters, values, targets, solved)
        return values, targets, solved

    keys = (*_FLOW_KEYS, "bulk_modulus_mpa", "bore_area_mm2", "rod_side_area_mm2", "stroke_mm")
    keys += ("dead_volume_1_mm3", "dead_volume_2_mm3", "pilot_ratio", "setting_2_mpa", "spool_area_mm2")
    outputs = (
        Quantity("chamber_1_pressure_rate_paps", "Pa/s"),
        Quantity("chamber_2_pressure_rate_paps", "Pa/s"),
    )
    return Problem("rates", inputs, outputs, 5, answer, _values(parameters, *keys))


def _allocate(input_count: int, output_count: int, rows: int, fill, parameters, *columns):
    inputs, targets = np.empty((rows, input_count)), np.empty((rows, output_count))
    solved = np.empty(rows, np.bool_)
    fill(parameters, *columns, inputs, targets, solved)
    return inputs, targets, solved
