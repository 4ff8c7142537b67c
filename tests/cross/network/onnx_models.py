"""ONNX files as other tools write them, made node by node."""

import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

RATES = {
    "hil.circuit": "paper",
    "hil.recipe": "flow",
}
INPUTS = [
    {"name": "chamber_1_pressure_mpa", "unit": "MPa", "low": 1.0, "high": 14.0},
    {"name": "chamber_2_pressure_mpa", "unit": "MPa", "low": 0.0, "high": 3.0},
    {"name": "valve_command_ratio", "unit": "1", "low": 0.0, "high": 1.0},
]
OUTPUTS = [
    {"name": "flow_1_per_command_lpmin", "unit": "L/min"},
    {"name": "flow_2_per_command_lpmin", "unit": "L/min"},
]


def properties(inputs=None, outputs=None, **more) -> dict[str, str]:
    """Metadata of a flow network of circuit paper in plain quantities."""
    networks = [{"role": "flow", "inputs": inputs or INPUTS, "outputs": outputs or OUTPUTS}]
    return RATES | {"hil.networks": json.dumps(networks)} | more


def save(path, nodes, constants, inputs=3, outputs=2, kind=TensorProto.FLOAT, metadata=None, opset=13, domains=()):
    """Write a model with input `x` and output `y`."""
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    tensors = [numpy_helper.from_array(np.asarray(value, dtype), name) for name, value in constants.items()]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("x", kind, ["n", inputs])],
        [helper.make_tensor_value_info("y", kind, ["n", outputs])],
        tensors,
    )
    imports = [helper.make_opsetid("", opset), *(helper.make_opsetid(name, version) for name, version in domains)]
    model = helper.make_model(graph, opset_imports=imports)
    model.ir_version = 8
    if metadata is None:
        metadata = properties()
    if metadata:
        helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return model


def weights(sizes, seed=0):
    """Random layers as (columns, rows) matrices, the way MatMul wants them."""
    random = np.random.default_rng(seed)
    return [
        (random.normal(size=(a, b)) / np.sqrt(a), random.normal(size=b) * 0.3)
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]


def keras_style(path, activation="Tanh", hidden=(12, 9)):
    """MatMul + Add + activation a layer, float32, as tf2onnx writes a Keras Sequential."""
    nodes, constants, at = [], {}, "x"
    layers = weights((3, *hidden, 2))
    for index, (kernel, bias) in enumerate(layers):
        constants[f"k{index}"], constants[f"b{index}"] = kernel, bias
        nodes.append(helper.make_node("MatMul", [at, f"k{index}"], [f"m{index}"]))
        last = index == len(layers) - 1
        nodes.append(helper.make_node("Add", [f"m{index}", f"b{index}"], ["y" if last else f"a{index}"]))
        at = f"a{index}"
        if last:
            break
        if activation == "SiLU":
            nodes.append(helper.make_node("Sigmoid", [at], [f"s{index}"]))
            nodes.append(helper.make_node("Mul", [at, f"s{index}"], [f"t{index}"]))
        else:
            nodes.append(helper.make_node(activation, [at], [f"t{index}"]))
        at = f"t{index}"
    save(path, nodes, constants)


def matlab_style(path):
    """Input normalisation, Gemm a layer, output scaling, float64."""
    layers = weights((3, 8, 6, 2), seed=3)
    constants = {"mean": [[7.0, 1.0, 0.5]], "std": [[2.0, 0.5, 0.3]], "gain": [[120.0, 80.0]], "shift": [3.0, -2.0]}
    nodes = [helper.make_node("Sub", ["x", "mean"], ["c"]), helper.make_node("Div", ["c", "std"], ["z"])]
    at = "z"
    for index, (kernel, bias) in enumerate(layers):
        constants[f"w{index}"], constants[f"b{index}"] = kernel.T, bias
        nodes.append(helper.make_node("Gemm", [at, f"w{index}", f"b{index}"], [f"g{index}"], transB=1))
        at = f"g{index}"
        if index < 2:
            nodes.append(helper.make_node("Tanh", [at], [f"t{index}"]))
            at = f"t{index}"
    nodes += [helper.make_node("Mul", [at, "gain"], ["u"]), helper.make_node("Add", ["u", "shift"], ["y"])]
    save(path, nodes, constants, kind=TensorProto.DOUBLE, opset=17)


def many_points_only(path):
    """Answers points in pairs: a table of them works, one point at a time (as in the period) does not."""
    constants = {"K": np.ones((3, 2))}
    nodes = [
        helper.make_node("Reshape", ["x", "pairs"], ["p"], name="in_pairs"),
        helper.make_node("Reshape", ["p", "rows"], ["r"]),
        helper.make_node("MatMul", ["r", "K"], ["y"]),
    ]
    model = save(path, nodes, constants)
    for name, shape in (("pairs", [2, -1]), ("rows", [-1, 3])):
        model.graph.initializer.append(numpy_helper.from_array(np.array(shape, np.int64), name))
    onnx.save(model, path)


def lstm(path):
    """A recurrent network: cannot be ported, can be run."""
    random = np.random.default_rng(0)
    constants = {
        "W": random.normal(size=(1, 16, 3)) * 0.3,
        "R": random.normal(size=(1, 16, 4)) * 0.3,
        "K": random.normal(size=(4, 2)),
    }
    nodes = [
        helper.make_node("Unsqueeze", ["x", "axis0"], ["xs"]),
        helper.make_node("LSTM", ["xs", "W", "R"], ["", "h", ""], name="memory", hidden_size=4),
        helper.make_node("Squeeze", ["h", "axis0"], ["hs"]),
        helper.make_node("MatMul", ["hs", "K"], ["y"]),
    ]
    model = save(path, nodes, constants)
    model.graph.initializer.append(numpy_helper.from_array(np.array([0], np.int64), "axis0"))
    onnx.save(model, path)
