"""The forms in which other tools write the same network: each loads into the port and into onnxruntime, with the same answers."""

import json

import numpy as np
import onnx
import onnx_models
import pytest
from onnx import TensorProto, helper, numpy_helper

from hilrunner.base.errors import ModelError
from hilrunner.plant.head import KERNEL_GRAPH
from hilrunner.plant.network import ROLES, assemble_bank, forward_many
from hilrunner.setup.model import load_model

ROW = {"free": ["n", 3], "one row": [1, 3], "four rows": [4, 3], "no rows": [3]}


def save(path, nodes, constants, input_shape=("n", 3), output_shape=("n", 2), more=(), kind=TensorProto.DOUBLE):
    """A model with input `x` and output `y` of these shapes; `more`: tensors of other types."""
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    tensors = [numpy_helper.from_array(np.asarray(value, dtype), name) for name, value in constants.items()]
    graph = helper.make_graph(
        nodes, "g",
        [helper.make_tensor_value_info("x", kind, list(input_shape))],
        [helper.make_tensor_value_info("y", kind, list(output_shape))],
        [*tensors, *more],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    helper.set_model_props(model, onnx_models.properties())
    onnx.save(model, path)
    return path


LAYERS = onnx_models.weights((3, 6, 5, 2), seed=7)


def expected(points):
    values = points
    for index, (kernel, bias) in enumerate(LAYERS):
        values = values @ kernel + bias
        values = np.tanh(values) if index < 2 else values
    return values


def answers(path, in_loop=False):
    """What the axis evaluates on random points, and those points as the file takes them."""
    points = np.random.default_rng(1).uniform([1, 0, 0], [14, 3, 1], (50, 3))
    surrogate, _ = load_model(path, "paper", in_loop=in_loop)
    bank = assemble_bank([surrogate])
    outputs = np.zeros((50, 2))
    in_si = np.ascontiguousarray(points * [1e6, 1e6, 1.0])
    assert forward_many(bank.words, bank.axis_start[0, ROLES["flow"]], in_si, outputs) == 0
    return points, outputs * 60e3


def dense(constants, at="x", last="y"):
    """Gemm and Tanh nodes of LAYERS."""
    nodes = []
    for index, (kernel, bias) in enumerate(LAYERS):
        constants[f"w{index}"], constants[f"b{index}"] = kernel, bias
        target = last if index == 2 else f"g{index}"
        nodes.append(helper.make_node("MatMul", [at, f"w{index}"], [f"m{index}"]))
        nodes.append(helper.make_node("Add", [f"m{index}", f"b{index}"], [target]))
        if index < 2:
            nodes.append(helper.make_node("Tanh", [target], [f"t{index}"]))
            at = f"t{index}"
    return nodes


@pytest.mark.parametrize("rows", ROW)
def test_the_loop_has_one_row_whatever_the_file_was_exported_with(tmp_path, rows):
    constants = {}
    shape = ROW[rows]
    path = save(tmp_path / "n.onnx", dense(constants), constants, shape, [*shape[:-1], 2])
    points, mine = answers(path)
    np.testing.assert_allclose(mine, expected(points), rtol=0, atol=1e-12)
    if rows == "four rows":
        with pytest.raises(ModelError, match="must have 4 rows at once.*dynamic_axes"):
            load_model(path, "paper", in_loop=True)
    else:
        np.testing.assert_allclose(answers(path, in_loop=True)[1], mine, rtol=0, atol=1e-12)


def behind_identities(constants):
    nodes = dense(constants)
    constants["w1t"] = constants.pop("w1").T
    constants["b1flat"] = constants.pop("b1").reshape(1, 1, 5)
    before = [
        helper.make_node("Transpose", ["w1t"], ["w1i"], perm=[1, 0]),
        helper.make_node("Identity", ["w1i"], ["w1"]),
        helper.make_node("Reshape", ["b1flat", "five"], ["b1i"]),
        helper.make_node("Cast", ["b1i"], ["b1"], to=TensorProto.DOUBLE),
    ]
    return [*before, *nodes], [numpy_helper.from_array(np.array([-1]), "five")]


def constant_forms(constants):
    nodes = dense(constants)
    bias = constants.pop("b0")
    before = [
        helper.make_node("Constant", [], ["b0s"], value_floats=np.zeros(6, np.float32).tolist()),
        helper.make_node("Constant", [], ["half"], value_float=0.5),
        helper.make_node("Constant", [], ["b0a"], value=numpy_helper.from_array(bias - 0.5)),
        helper.make_node("Cast", ["half"], ["halfd"], to=TensorProto.DOUBLE),
        helper.make_node("Cast", ["b0s"], ["b0d"], to=TensorProto.DOUBLE),
        helper.make_node("Add", ["b0a", "halfd"], ["b0h"]),
        helper.make_node("Add", ["b0h", "b0d"], ["b0"]),
    ]
    return [*before, *nodes], []


@pytest.mark.parametrize("form", [behind_identities, constant_forms])
def test_constants_behind_other_nodes_are_constants(tmp_path, form):
    constants = {}
    nodes, more = form(constants)
    path = save(tmp_path / "n.onnx", nodes, constants, more=more)
    points, mine = answers(path)
    np.testing.assert_allclose(mine, expected(points), rtol=0, atol=1e-12)
    np.testing.assert_allclose(answers(path, in_loop=True)[1], mine, rtol=0, atol=1e-12)


@pytest.mark.parametrize("image", [(3, 1, 1), (1, 1, 3)], ids=["channels", "one wide row"])
def test_convolutions_over_the_whole_row_are_layers(tmp_path, image):
    """As MATLAB writes fully connected layers, with its normalisation in the image's shape."""
    constants = {
        "mean": np.array([1.0, 2.0, 0.5]).reshape(1, *image),
        "gain": np.array([0.5, 2.0, 1.5]).reshape(1, *image),
    }
    nodes = [helper.make_node("Sub", ["x", "mean"], ["c"]), helper.make_node("Mul", ["c", "gain"], ["s"])]
    at = "s"
    for index, (kernel, bias) in enumerate(LAYERS):
        shape = image if index == 0 else (len(kernel), 1, 1)
        constants[f"w{index}"], constants[f"b{index}"] = kernel.T.reshape(-1, *shape), bias
        nodes.append(helper.make_node("Conv", [at, f"w{index}", f"b{index}"], [f"f{index}"]))
        at = f"f{index}"
        if index < 2:
            nodes.append(helper.make_node("Tanh", [at], [f"t{index}"]))
            at = f"t{index}"
    nodes.append(helper.make_node("Flatten", [at], ["y"]))
    path = save(tmp_path / "n.onnx", nodes, constants, ["n", *image], kind=TensorProto.FLOAT)
    points, mine = answers(path)
    np.testing.assert_allclose(mine, expected((points - [1.0, 2.0, 0.5]) * [0.5, 2.0, 1.5]), rtol=0, atol=1e-5)
    np.testing.assert_allclose(answers(path, in_loop=True)[1], mine, rtol=0, atol=1e-4)


def test_a_convolution_that_looks_at_part_of_a_row_is_refused_by_name_with_a_remedy_that_works(tmp_path):
    constants = {"w": np.ones((2, 1, 1, 2)), "k": np.ones((4, 2))}
    nodes = [
        helper.make_node("Conv", ["x", "w"], ["f"], name="slides"),
        helper.make_node("Flatten", ["f"], ["r"]),
        helper.make_node("MatMul", ["r", "k"], ["y"]),
    ]
    path = save(tmp_path / "n.onnx", nodes, constants, ["n", 1, 1, 3], kind=TensorProto.FLOAT)
    with pytest.raises(ModelError, match="node 0, Conv 'slides'.*does not cover a whole row.*--engine onnx"):
        load_model(path, "paper")
    load_model(path, "paper", in_loop=True)


def test_batch_normalisation_is_a_scale_and_an_offset_anywhere(tmp_path):
    random = np.random.default_rng(5)
    constants, nodes, normal = {}, dense({}), {}
    nodes = dense(constants, at="n0")
    nodes.insert(2, helper.make_node("BatchNormalization", ["g0", *(f"{k}1" for k in "GBMV")], ["n1"], epsilon=1e-3))
    nodes[3] = helper.make_node("Tanh", ["n1"], ["t0"])
    nodes.insert(0, helper.make_node("BatchNormalization", ["x", *(f"{k}0" for k in "GBMV")], ["n0"]))
    for place, width in ((0, 3), (1, 6)):
        values = (
            random.normal(size=width),
            random.normal(size=width),
            random.normal(size=width),
            random.uniform(0.5, 2, width),
        )
        normal[place] = values
        constants |= {f"{key}{place}": value for key, value in zip("GBMV", values, strict=True)}
    path = save(tmp_path / "n.onnx", nodes, constants)

    def normalised(values, place, epsilon):
        gain, shift, mean, variance = normal[place]
        return (values - mean) / np.sqrt(variance + epsilon) * gain + shift

    points, mine = answers(path)
    values = normalised(points, 0, 1e-5)
    values = np.tanh(normalised(values @ LAYERS[0][0] + LAYERS[0][1], 1, 1e-3))
    values = np.tanh(values @ LAYERS[1][0] + LAYERS[1][1]) @ LAYERS[2][0] + LAYERS[2][1]
    np.testing.assert_allclose(mine, values, rtol=0, atol=1e-6)
    np.testing.assert_allclose(answers(path, in_loop=True)[1], mine, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dynamo", [False, True], ids=["TorchScript", "dynamo"])
def test_torchs_export_with_nothing_but_an_example_row(tmp_path, dynamo):
    import warnings

    import torch

    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(3, 8), torch.nn.BatchNorm1d(8), torch.nn.Tanh(), torch.nn.Linear(8, 2)
    ).double().eval()  # fmt: skip
    path = tmp_path / "t.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(net, (torch.zeros(1, 3, dtype=torch.float64),), str(path), dynamo=dynamo)
    description = {**onnx_models.RATES, "hil.networks": json.loads(onnx_models.properties()["hil.networks"])}
    (tmp_path / "t.onnx.json").write_text(json.dumps(description))
    for in_loop in (False, True):
        points, mine = answers(path, in_loop)
        theirs = net(torch.tensor(points)).detach().numpy()
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-6)


def blocks(torch, normalised):
    """A residual network with layer normalisation, a skip of the input and a gate."""

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.first, self.second, self.third = (torch.nn.Linear(a, b) for a, b in ((3, 8), (8, 8), (11, 2)))
            self.norm = torch.nn.LayerNorm(8) if normalised else torch.nn.Identity()
            self.gate = torch.nn.Linear(3, 8)

        def forward(self, x):
            scaled = (x - 2.0) / torch.tensor([4.0, 1.0, 0.5], dtype=x.dtype)
            one = torch.tanh(self.first(scaled))
            two = one + self.norm(torch.nn.functional.silu(self.second(one)))
            return self.third(torch.cat([two * torch.sigmoid(self.gate(scaled)), scaled], dim=-1))

    torch.manual_seed(3)
    return Net().double().eval()


@pytest.mark.parametrize("opset", [13, 17], ids=["normalisation spelt out", "as one node"])
def test_residual_links_layer_normalisation_gates_and_skips_are_compiled(tmp_path, opset):
    import warnings

    import torch

    net = blocks(torch, True)
    path = tmp_path / "r.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(net, (torch.zeros(1, 3, dtype=torch.float64),), str(path), dynamo=False, opset_version=opset)
    description = {**onnx_models.RATES, "hil.networks": json.loads(onnx_models.properties()["hil.networks"])}
    # columns and units are the file's own business
    description["hil.networks"][0]["outputs"].reverse()
    (tmp_path / "r.onnx.json").write_text(json.dumps(description))
    surrogate, report = load_model(path, "paper")
    assert surrogate.networks["flow"].kernel == KERNEL_GRAPH and "by " in report.text()
    for in_loop in (False, True):
        points, mine = answers(path, in_loop)
        theirs = net(torch.tensor(points)).detach().numpy()[:, ::-1]
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-6)


def test_a_branch_that_cannot_be_ported_is_refused_by_its_node(tmp_path):
    constants = {"w": np.ones((3, 4)), "v": np.ones((4, 2))}
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["a"]),
        helper.make_node("Softmax", ["a"], ["s"], name="attention"),
        helper.make_node("Mul", ["a", "s"], ["m"]),
        helper.make_node("MatMul", ["m", "v"], ["y"]),
    ]
    path = save(tmp_path / "n.onnx", nodes, constants)
    with pytest.raises(ModelError, match="node 1, Softmax 'attention'.*--engine onnx"):
        load_model(path, "paper")
    load_model(path, "paper", in_loop=True)


def test_a_network_of_branches_too_large_for_a_period_is_refused_with_its_limit(tmp_path):
    constants = {"w": np.ones((3, 3000)) / 3000, "v": np.ones((3000, 2)) / 3000}
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["a"]),
        helper.make_node("Tanh", ["a"], ["t"]),
        helper.make_node("Add", ["a", "t"], ["s"]),
        helper.make_node("MatMul", ["s", "v"], ["y"]),
    ]
    with pytest.raises(ModelError, match="values between its layers.*at most 4096"):
        load_model(save(tmp_path / "n.onnx", nodes, constants), "paper")
