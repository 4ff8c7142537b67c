"""What the networks are taught: the plant's own answers, in the inputs the reduced model will ask with; and the whole command."""

import json

import numpy as np
import onnx
import pytest

from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.plant import surrogate
from hilrunner.plant.hydraulics import inverse_orifice_root, orifice_root
from hilrunner.plant.line import line_balance
from hilrunner.plant.parameters import make_parameters
from hilrunner.training.recipes import make_recipe
from hilrunner.training.sampling import unit_points


def answers(circuit, recipe, preset, role, rows=400):
    parameters = make_parameters(preset)
    problem = next(p for p in make_recipe(circuit, recipe, parameters).problems if p.role == role)
    inputs, targets, solved = problem.answer(unit_points(0, rows, rows, problem.dimensions, 1))
    assert solved.all() and np.isfinite(targets).all()
    low = np.array([q.low for q in problem.inputs])
    high = np.array([q.high for q in problem.inputs])
    assert np.all(inputs >= low - 1e-9 * abs(low)) and np.all(inputs <= high + 1e-9 * abs(high))
    return parameters, problem, inputs, targets


@pytest.mark.parametrize(
    ("circuit", "recipe", "preset", "role"),
    [
        (status.CIRCUIT_LIFT, "flow", "lift", "supply"),
        (status.CIRCUIT_LIFT, "flow", "lift", "return"),
        (status.CIRCUIT_PAPER, "flow", "paper", "flow"),
        (status.CIRCUIT_PAPER, "paper", "paper", "rates"),
    ],
)
def test_samples_reach_the_ends_of_the_declared_range(circuit, recipe, preset, role):
    _, problem, inputs, _ = answers(circuit, recipe, preset, role, rows=4000)
    for column, quantity in zip(inputs.T, problem.inputs, strict=True):
        span = quantity.high - quantity.low
        assert column.min() < quantity.low + 0.1 * span and column.max() > quantity.high - 0.1 * span, quantity.name


def test_supply_targets_close_the_line_balance():
    """The learned pressure put back into the plant's residual gives zero, for any valve and spool behind the inputs."""
    parameters, _, inputs, targets = answers(status.CIRCUIT_LIFT, "flow", "lift", "supply")
    prm = parameters[0]
    for (demand_root, share, drop), (over,) in zip(inputs, targets, strict=True):
        chamber = prm["supply_pressure_pa"] - drop
        demand = demand_root**2
        valve = demand * prm["check_si"] / orifice_root(drop, prm["transition_pressure_pa"])
        cbv = share / (1.0 - share) * prm["check_si"] * demand / surrogate.SHARE_ROOT
        left = line_balance(prm, chamber + over, chamber, cbv, valve, 0.0)
        assert abs(left) < 1e-6 * valve * np.sqrt(prm["supply_pressure_pa"])


def test_return_targets_close_the_line_balance_for_any_size_of_valve():
    parameters, _, inputs, targets = answers(status.CIRCUIT_LIFT, "flow", "lift", "return")
    prm = parameters[0]
    for size in (0.3, 1.0):
        for (root, share), (ratio,) in zip(inputs, targets, strict=True):
            chamber = prm["tank_pressure_pa"] + inverse_orifice_root(root, prm["transition_pressure_pa"])
            valve = size * prm["valve_at_si"]
            cbv = share / (1.0 - share) * valve
            line = prm["tank_pressure_pa"] + inverse_orifice_root(root * ratio, prm["transition_pressure_pa"])
            left = line_balance(prm, line, chamber, cbv, 0.0, valve)
            assert abs(left) < 1e-5 * valve * root  # the solver stops at 5 Pa


def test_the_range_of_the_return_network_holds_every_command_and_spool():
    parameters, problem, _, _ = answers(status.CIRCUIT_LIFT, "flow", "lift", "return", rows=10)
    from hilrunner.plant.line import valve_conductances

    prm = parameters[0]
    for command in np.linspace(-1.0, 1.0, 4001):
        # the line that is not supplied; the other one, where the centre bleed still leaks, is solved exactly
        valve = valve_conductances(prm, float(command))[3 if command >= 0.0 else 1]
        assert prm["cbv_si"] / (prm["cbv_si"] + valve) <= problem.inputs[1].high * (1 + 1e-6)


def test_flow_targets_are_the_circuits_flows_per_command():
    from hilrunner.plant.rates_paper import paper_flows

    parameters, _, inputs, targets = answers(status.CIRCUIT_PAPER, "flow", "paper", "flow")
    prm = parameters[0]
    for (p1, root, share), flows in zip(inputs, targets, strict=True):
        p2 = prm["tank_pressure_pa"] + inverse_orifice_root(root, prm["transition_pressure_pa"])
        for command in (0.2, 0.9):
            cbv = min(share, 1.0 - 1e-12) / (1.0 - min(share, 1.0 - 1e-12)) * prm["valve_bt_si"] * command
            flow_1, flow_2, _ = paper_flows(prm, p1, p2, cbv, command)
            np.testing.assert_allclose([flow_1, flow_2], flows * command, rtol=1e-6, atol=1e-12)


def test_the_articles_recipe_uses_its_table_2_and_its_six_hundred_and_seventy_two_parameters():
    parameters, problem, _, _ = answers(status.CIRCUIT_PAPER, "paper", "paper", "rates", rows=10)
    assert [(q.low, q.high) for q in problem.inputs] == [
        (0.0, 2.0),
        (-1.0, 1.0),
        (7.5e6, 9.5e6),
        (-1e6, 1e6),
        (0.0, 1.0),
    ]
    from hilrunner.training.mlp import Shape

    assert Shape((5, *problem.layers, 2)).parameter_count == 672


def test_a_recipe_that_does_not_exist_is_refused():
    with pytest.raises(UsageError, match="no such recipe"):
        make_recipe(status.CIRCUIT_LIFT, "paper", make_parameters("lift"))
    with pytest.raises(UsageError, match="lift-lines"):
        make_recipe(status.CIRCUIT_LIFT_LINES, "flow", make_parameters("lift"))


SMALL = [
    "--points",
    "300",
    "--validation-points",
    "100",
    "--test-points",
    "200",
    "--stages",
    "300:12",
    "--layers",
    "6,5",
]


def test_the_command_makes_a_checked_model_with_data_sheet_curves_and_golden_vectors(tmp_path, capsys):
    from hilrunner.cli import main
    from hilrunner.setup.model import load_model

    assert main(["train", "--profile", "amc-lift", "--out", str(tmp_path), "--json", *SMALL]) == 0
    sheet = json.loads(capsys.readouterr().out)
    path = tmp_path / "lift-flow.onnx"
    assert sheet["path"] == str(path) and (tmp_path / "lift-flow.curves.png").stat().st_size > 1000
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert max(entry.version for entry in model.opset_import) <= 20 and model.ir_version <= 10
    assert not any(tensor.data_location for tensor in model.graph.initializer)
    keys = {entry.key: entry.value for entry in model.metadata_props}
    golden = json.loads(keys["hil.golden"])
    assert set(golden) == {"supply", "return"} and len(golden["supply"]["inputs"]) == sheet["golden_vectors"]
    surrogate_networks, report = load_model(path, "lift", make_parameters("lift"))
    assert set(surrogate_networks.networks) == {"supply", "return"} and "golden" in report.text()
    for facts in sheet["networks"]:
        assert facts["iterations"] == 12 and facts["effective_parameters"] >= 0.0 and facts["layers"] == [6, 5]
    # resumed when finished: nothing is trained again, the same file comes out
    before = path.read_bytes()
    assert main(["train", "--profile", "amc-lift", "--out", str(tmp_path), "--resume", "--json", *SMALL]) == 0
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["--stages", "5"], "--stages"),
        (["--stages", "a:b"], "--stages"),
        (["--layers", "0"], "--layers"),
        (["--layers", "x"], "--layers"),
        (["--points", "0"], "--points"),
        (["--axis", "nobody"], "--axis"),
    ],
)
def test_impossible_wishes_exit_with_2(words, word, tmp_path, capsys):
    from hilrunner.cli import main

    assert main(["train", "--out", str(tmp_path), *words]) == 2
    assert word in capsys.readouterr().err


def test_rivals_are_trained_for_the_same_time_and_reported(tmp_path, capsys):
    from hilrunner.cli import main

    assert main(["train", "--profile", "paper", "--out", str(tmp_path), "--json", "--rivals", *SMALL]) == 0
    rows = json.loads(capsys.readouterr().out)["rivals"]
    assert [row["method"] for row in rows] == ["Adam", "L-BFGS"]
    assert all(0.0 < row["normalised_mean_square"] < 10.0 for row in rows)  # in a tenth of a second, nothing more
