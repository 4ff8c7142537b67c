"""The same network by compiled kernel, onnxruntime and torch: equal to rounding, for shipped models and foreign ones."""

import hashlib
import json
import warnings

import networks
import numpy as np
import onnx_models
import onnxruntime
import pytest

from hilrunner.base import status
from hilrunner.base.errors import ModelError
from hilrunner.plant import load, step
from hilrunner.plant.network import ROLES, assemble_bank, forward_many
from hilrunner.plant.parameters import make_parameters
from hilrunner.setup import resources
from hilrunner.setup.model import load_model

SHIPPED = [
    ("lift-flow.onnx", "lift", "lift"),
    ("paper-flow.onnx", "paper", "paper"),
]


def compiled_values(surrogate, role, inputs):
    bank = assemble_bank([surrogate])
    outputs = np.zeros((len(inputs), surrogate.networks[role].output_count))
    assert forward_many(bank.words, bank.axis_start[0, ROLES[role]], np.ascontiguousarray(inputs), outputs) == 0
    return outputs


@pytest.mark.parametrize("name,circuit,preset", SHIPPED)
def test_shipped_model_onnxruntime_torch_and_kernel_agree(name, circuit, preset):
    import torch

    path = resources.models_folder() / name
    surrogate, _ = load_model(path, circuit, make_parameters(preset))
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for role, network in surrogate.networks.items():
        inputs = np.random.default_rng(1).uniform(network.input_low, network.input_high, (500, network.input_count))
        feeds = {value.name: np.zeros((500, value.shape[1])) for value in session.get_inputs()} | {role: inputs}
        (theirs,) = session.run([f"{role}_out"], feeds)
        mine = compiled_values(surrogate, role, inputs)
        x = torch.tensor((inputs - network.input_offset) * network.input_scale)
        for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            x = torch.addmm(torch.tensor(bias), x, torch.tensor(weight).T)
            x = torch.tanh(x) if index < len(network.weights) - 1 else x
        torchs = x.numpy() * network.output_scale + network.output_offset
        span = np.ptp(theirs, axis=0)
        assert np.abs((mine - theirs) / span).max() < 2e-14
        assert np.abs((torchs - theirs) / span).max() < 2e-14


@pytest.mark.parametrize("name,circuit,preset", SHIPPED)
def test_shipped_model_has_a_data_sheet_that_tells_its_hash_seed_ranges_and_errors(name, circuit, preset):
    path = resources.models_folder() / name
    sheet = json.loads(path.with_name(name + ".json").read_text("utf-8"))
    assert sheet["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert sheet["made_by"].startswith("hilrunner train")
    assert sheet["circuit"] == circuit and isinstance(sheet["seed"], int)
    for facts in sheet["networks"]:
        assert facts["unsolved_points"] == 0 and facts["test"]["points"] >= 100_000
        assert all(quantity["low"] < quantity["high"] for quantity in facts["inputs"])
        assert len(facts["test"]["rms"]) == len(facts["outputs"])
        assert facts["test"]["normalised_mean_square"] < facts["test"]["constant_predictor_normalised_mean_square"]


@pytest.mark.parametrize("activation", ["Tanh", "Sigmoid", "Relu", "SiLU", "Softplus", "Elu"])
def test_a_keras_style_network_loads_in_its_own_units(tmp_path, activation):
    path = tmp_path / "k.onnx"
    onnx_models.keras_style(path, activation)
    surrogate, report = load_model(path, "paper")
    network = surrogate.networks["flow"]
    points = np.random.default_rng(0).uniform([1, 0, 0], [14, 3, 1], (100, 3))
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (theirs,) = session.run(None, {"x": points.astype(np.float32)})
    mine = compiled_values(surrogate, "flow", points * [1e6, 1e6, 1.0])  # the plant speaks Pa and m^3/s
    np.testing.assert_allclose(mine * 60e3, theirs, rtol=0.0, atol=3e-5 * np.ptp(theirs))
    assert "3 -> 12 -> 9 -> 2" in report.text() and network.parameter_count == 3 * 12 + 12 + 12 * 9 + 9 + 18 + 2


def test_a_matlab_style_network_keeps_its_scaling_to_rounding(tmp_path):
    path = tmp_path / "m.onnx"
    onnx_models.matlab_style(path)
    surrogate, report = load_model(path, "paper")
    points = np.random.default_rng(0).uniform([1, 0, 0], [14, 3, 1], (100, 3))
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (theirs,) = session.run(None, {"x": points})
    mine = compiled_values(surrogate, "flow", points * [1e6, 1e6, 1.0])
    np.testing.assert_allclose(mine * 60e3, theirs, rtol=0.0, atol=1e-12 * np.ptp(theirs))
    assert report.largest_difference_ratio < 1e-12


@pytest.mark.parametrize("activation", ["tanh", "logistic", "relu"])
def test_a_scikit_learn_network_loads_from_skl2onnx(tmp_path, activation):
    import skl2onnx
    from skl2onnx.common.data_types import DoubleTensorType
    from sklearn.neural_network import MLPRegressor

    random = np.random.default_rng(0)
    x = random.uniform([1, 0, 0], [14, 3, 1], (300, 3))
    y = np.stack([x[:, 0] * 0.1 + x[:, 2], np.sin(x[:, 1]) - x[:, 2]], axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it need not converge
        fitted = MLPRegressor(hidden_layer_sizes=(10, 7), activation=activation, max_iter=20, random_state=0).fit(x, y)
    model = skl2onnx.to_onnx(fitted, initial_types=[("x", DoubleTensorType([None, 3]))], target_opset=15)
    path = tmp_path / "s.onnx"
    path.write_bytes(model.SerializeToString())
    # what it means stands beside it: the tool knows nothing of quantities
    description = {**onnx_models.RATES, "hil.networks": json.loads(onnx_models.properties()["hil.networks"])}
    (tmp_path / "s.onnx.json").write_text(json.dumps(description))
    surrogate, _ = load_model(path, "paper")
    mine = compiled_values(surrogate, "flow", x * [1e6, 1e6, 1.0]) * 60e3
    np.testing.assert_allclose(mine, fitted.predict(x), rtol=0.0, atol=1e-9 * np.ptp(y))


def test_columns_are_put_into_the_plants_order(tmp_path):
    path = tmp_path / "p.onnx"
    turned = [onnx_models.INPUTS[2], onnx_models.INPUTS[0], onnx_models.INPUTS[1]]
    onnx_models.matlab_style(path)
    straight, _ = load_model(path, "paper")
    description = onnx_models.properties(inputs=turned, outputs=onnx_models.OUTPUTS[::-1])
    crossed, _ = load_model(path, "paper", description=description)
    points = np.random.default_rng(0).uniform([1e6, 0, 0], [14e6, 3e6, 1], (20, 3))
    # the file's first column is now the command, its second p1, its third p2
    scale = np.array([1e6, 1e6, 1.0])
    file_columns = (points / scale)[:, [2, 0, 1]]
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (theirs,) = session.run(None, {"x": file_columns})
    np.testing.assert_allclose(compiled_values(crossed, "flow", points) * 60e3, theirs[:, ::-1], rtol=1e-9)
    assert not np.allclose(compiled_values(crossed, "flow", points), compiled_values(straight, "flow", points))


def run_paper(engine, surrogate, ticks=20):
    parameters = make_parameters("paper")
    axis = step.AxisPlant(0, parameters, load.knuckle_boom(), engine=engine, substep_count=2, networks=surrogate)
    model = step.assemble([axis])
    states, flags = np.zeros((ticks, 10)), np.zeros(ticks, np.int64)
    start = step.initial_state(axis, 0.6, 0.5)
    commands, ones = np.linspace(0.5, 0.7, ticks), np.ones(ticks)
    step.advance_many(model, 0, commands, ones, 1e-3, start, np.zeros(step.SCRATCH_SIZE), states, flags)
    return states, flags


LIBRARIES = pytest.mark.parametrize("library", ["C API", "Python callback"])


@LIBRARIES
def test_a_call_that_fails_is_told_in_onnxruntimes_words(library, monkeypatch, tmp_path):
    from hilrunner.setup import model_onnxruntime

    if library == "Python callback":
        monkeypatch.setattr(model_onnxruntime, "library_path", lambda: None)
    path = tmp_path / "pairs.onnx"
    onnx_models.many_points_only(path)
    with pytest.raises(ModelError) as refused:
        load_model(path, "paper", in_loop=True)
    text = str(refused.value)
    for word in (str(path), "cannot run one row of it", "network 'flow'", "in_pairs", "cannot be reshaped"):
        assert word in text, text
    assert len(text.splitlines()) == 1


def test_a_call_that_fails_in_a_run_is_told_at_its_end(monkeypatch, capsys):
    """The model was fine when it was loaded; what the callback says must outlive the period."""
    from hilrunner import cli
    from hilrunner.setup import model_onnxruntime

    monkeypatch.setattr(model_onnxruntime, "library_path", lambda: None)
    honest, calls = onnxruntime.InferenceSession.run_with_iobinding, []

    def tiring(session, binding):
        calls.append(1)
        if len(calls) > 600:  # 512 of them compare the two networks with onnxruntime
            raise RuntimeError("the arena is full\nand more that nobody reads")
        return honest(session, binding)

    monkeypatch.setattr(onnxruntime.InferenceSession, "run_with_iobinding", tiring)
    words = ["simulate", "--schedule", "steps", "--duration", "1.5", "--engine", "onnx"]
    assert cli.main(words) == 1
    out = capsys.readouterr().out
    assert "left the finite numbers" in out
    assert "onnxruntime: the arena is full\n" in out and "axis luffing: network '" in out and "nobody" not in out


@LIBRARIES
def test_engine_onnx_gives_the_compiled_kernels_trajectory(library, monkeypatch):
    from hilrunner.setup import model_onnxruntime

    if library == "Python callback":
        monkeypatch.setattr(model_onnxruntime, "library_path", lambda: None)
    path = resources.models_folder() / "paper-flow.onnx"
    kernel, _ = load_model(path, "paper")
    through, report = load_model(path, "paper", in_loop=True)
    assert "onnxruntime" in report.text()
    mine, flags = run_paper(status.ENGINE_SURROGATE, kernel)
    theirs, other_flags = run_paper(status.ENGINE_ONNX, through)
    assert flags.tolist() == other_flags.tolist() == [0] * 20
    np.testing.assert_allclose(theirs[:, :4], mine[:, :4], rtol=1e-12, atol=1e-12)


def test_what_cannot_be_ported_still_runs_by_onnxruntime(tmp_path):
    path = tmp_path / "lstm.onnx"
    onnx_models.lstm(path)
    surrogate, _ = load_model(path, "paper", in_loop=True)
    points = np.random.default_rng(0).uniform([1e6, 0, 0], [14e6, 3e6, 1], (1, 3))
    outputs = compiled_values(surrogate, "flow", points)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (theirs,) = session.run(None, {"x": (points / [1e6, 1e6, 1.0]).astype(np.float32)})
    np.testing.assert_allclose(outputs * 60e3, theirs, rtol=1e-6)


def test_an_engine_without_its_session_gives_nan_and_a_failure():
    network = networks.make(3, 2)
    from dataclasses import replace

    from hilrunner.plant.foreign_call import FOREIGN_SIZE
    from hilrunner.plant.network import SurrogateNetworks

    orphan = replace(network, foreign=np.zeros(FOREIGN_SIZE, np.int64))
    bank = assemble_bank([SurrogateNetworks(1, {"flow": orphan})])
    outputs = np.zeros((3, 2))
    assert forward_many(bank.words, bank.axis_start[0, 0], np.zeros((3, 3)), outputs) == 3
    assert np.isnan(outputs).all()
