"""One pass through a surrogate's network, one after the other as RK4 needs them: compiled kernel against rivals.

The rivals get the same weights in float64 and only the pass itself; what a plant step needs besides is left out in their
favour.
"""

import platform
import time
from collections.abc import Callable

import numpy as np

from hilrunner.base.compiled import entry
from hilrunner.bench.results import Table
from hilrunner.bench.turns import fingerprint, median_ratio, time_turns
from hilrunner.plant import vector_kernel
from hilrunner.plant.network import Mlp, SurrogateNetworks, assemble_bank, forward_at

_POINTS = 256  # different inputs in turn, a power of two
_Y_AT = 16
OURS = "compiled (ours)"
_TANH_VECTOR_OPERATIONS = 20  # of plant.vector_kernel's tanh, the division counted once


@entry
def _passes(words, start, inputs, work, count):
    """`count` passes, each waiting for the one before it (0 * y changes nothing but the order)."""
    input_count = inputs.shape[1]
    for i in range(count):
        row = inputs[i & (_POINTS - 1)]
        for k in range(input_count):
            work[k] = row[k] + 0.0 * work[_Y_AT]
        forward_at(words, start, work, 0, _Y_AT)
    return work[_Y_AT]


@entry
def _shift_chain(count):
    """Marsaglia's xorshift: six shifts and exclusive ors that wait for each other, one cycle each on x86-64."""
    value = np.uint64(88172645463325252)
    for _ in range(count):
        value ^= value << np.uint64(13)
        value ^= value >> np.uint64(7)
        value ^= value << np.uint64(17)
    return value


def clock_ghz() -> float | None:
    """The core's clock while it computes, from a chain of known latency; None where the latency is not known."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return None
    count = 2_000_000
    _shift_chain(10)
    best_s = float("inf")
    for _ in range(5):
        start_s = time.perf_counter()
        _shift_chain(count)
        best_s = min(best_s, time.perf_counter() - start_s)
    return 6 * count / best_s / 1e9


def vector_operations(network: Mlp, lanes: int) -> int:
    """Vector multiply-adds and tanh arithmetic of one pass, whole vectors of `lanes`."""
    vectors = [-(-size // lanes) for size in network.layer_sizes[1:-1]]
    multiply_adds = sum(count * v for count, v in zip(network.layer_sizes[:-2], vectors, strict=True))
    return multiply_adds + network.output_count * vectors[-1] + _TANH_VECTOR_OPERATIONS * sum(vectors)


def inputs_of(network: Mlp, seed: int = 1) -> np.ndarray:
    """Points inside the training range, float64[256, inputs]."""
    ratio = np.random.default_rng(seed).random((_POINTS, network.input_count))
    return network.input_low + ratio * (network.input_high - network.input_low)


def _compiled(network: Mlp, points: np.ndarray, role: str, networks: SurrogateNetworks) -> Callable[[int], object]:
    bank = assemble_bank(
        [SurrogateNetworks(recipe=networks.recipe, networks={role: network}, circuit=networks.circuit)]
    )
    start = int(bank.axis_start.max())
    work = np.zeros(64)
    return lambda count: _passes(bank.words, start, points, work, count)


def _numpy(network: Mlp, points: np.ndarray) -> Callable[[int], object]:
    layers = list(zip(network.weights, network.biases, strict=True))
    offset, scale = network.input_offset, network.input_scale
    out_scale, out_offset = network.output_scale, network.output_offset

    def run(count: int) -> np.ndarray:
        for i in range(count):
            z = (points[i & (_POINTS - 1)] - offset) * scale
            for weight, bias in layers[:-1]:
                z = np.tanh(weight @ z + bias)
            z = (layers[-1][0] @ z + layers[-1][1]) * out_scale + out_offset
        return z

    return run


def onnx_bytes(network: Mlp) -> bytes:
    """The network as an ONNX graph, float64, scaling inside, one row in and out."""
    from onnx import TensorProto, helper, numpy_helper

    constants, nodes = [], []

    def constant(name: str, value: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(value, np.float64), name))
        return name

    nodes.append(helper.make_node("Sub", ["x", constant("input_offset", network.input_offset)], ["centred"]))
    nodes.append(helper.make_node("Mul", ["centred", constant("input_scale", network.input_scale)], ["z0"]))
    last = len(network.weights) - 1
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        names = [f"z{k}", constant(f"w{k}", weight.T), constant(f"b{k}", bias)]
        nodes.append(helper.make_node("Gemm", names, [f"s{k}"]))
        if k < last:
            nodes.append(helper.make_node("Tanh", [f"s{k}"], [f"z{k + 1}"]))
    nodes.append(helper.make_node("Mul", [f"s{last}", constant("output_scale", network.output_scale)], ["scaled"]))
    nodes.append(helper.make_node("Add", ["scaled", constant("output_offset", network.output_offset)], ["y"]))
    graph = helper.make_graph(
        nodes,
        "pass",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, [1, network.input_count])],
        [helper.make_tensor_value_info("y", TensorProto.DOUBLE, [1, network.output_count])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return model.SerializeToString()


def _onnxruntime(network: Mlp, points: np.ndarray) -> Callable[[int], object]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx_bytes(network), options, providers=["CPUExecutionProvider"])
    x = points[:1].copy()
    y = np.zeros((1, network.output_count))
    binding = session.io_binding()
    binding.bind_input("x", "cpu", 0, np.float64, x.shape, x.ctypes.data)
    binding.bind_output("y", "cpu", 0, np.float64, y.shape, y.ctypes.data)

    def run(count: int) -> np.ndarray:
        for i in range(count):
            x[0] = points[i & (_POINTS - 1)]
            session.run_with_iobinding(binding)
        return y[0]

    return run


def _torch(network: Mlp, points: np.ndarray) -> Callable[[int], object] | None:
    try:
        import torch
    except ImportError:
        return None
    torch.set_num_threads(1)
    layers = [
        (torch.tensor(np.ascontiguousarray(w)), torch.tensor(np.ascontiguousarray(b)))
        for w, b in zip(network.weights, network.biases, strict=True)
    ]
    offset, scale = torch.tensor(network.input_offset), torch.tensor(network.input_scale)
    out_scale, out_offset = torch.tensor(network.output_scale), torch.tensor(network.output_offset)
    rows = torch.tensor(points)

    def run(count: int) -> np.ndarray:
        with torch.inference_mode():
            for i in range(count):
                z = (rows[i & (_POINTS - 1)] - offset) * scale
                for weight, bias in layers[:-1]:
                    z = torch.tanh(torch.nn.functional.linear(z, weight, bias))
                z = torch.nn.functional.linear(z, *layers[-1]) * out_scale + out_offset
        return z.numpy()

    return run


def pass_table(name: str, networks: SurrogateNetworks, role: str, rounds: int, slice_s: float) -> Table:
    """One network of a surrogate against numpy, onnxruntime and (where installed) torch, in turns."""
    network = networks.networks[role]
    points = inputs_of(network)
    runs = {OURS: _compiled(network, points, role, networks), "numpy": _numpy(network, points)}
    runs["onnxruntime, IOBinding"] = _onnxruntime(network, points)
    if torch_run := _torch(network, points):
        runs["torch, inference mode"] = torch_run
    last = {name: np.atleast_1d(run(_POINTS))[0] for name, run in runs.items()}
    times = time_turns(runs, rounds, slice_s)
    rows = [
        (rival, float(np.median(ns)), min(ns), median_ratio(ns, times[OURS]), fingerprint(np.float32(last[rival])))
        for rival, ns in times.items()
    ]
    shape = "-".join(map(str, network.layer_sizes))
    notes = _limit_notes(network, float(np.median(times[OURS])))
    if torch_run is None:
        notes.append("torch is not installed")
    worst = max(abs(value / last[OURS] - 1.0) for value in last.values())
    notes.append(f"results agree within {worst:.1e} of the value at the last point")
    values = {f"{rival.split(',')[0].split(' ')[0]}_ns": ns for rival, ns in times.items()}
    columns = ("", "median ns", "best ns", "times ours", "result")
    title = f"One pass through the {role} network of {name}, {shape}, float64, {rounds} rounds in turns"
    return Table(f"pass_{name}_{role}", title, columns, rows, notes, values)


def _limit_notes(network: Mlp, measured_ns: float) -> list[str]:
    ghz = clock_ghz()
    if ghz is None:
        return []
    lanes = vector_kernel.host_lanes()
    count = vector_operations(network, lanes)
    limit_ns = count / 2 / ghz
    return [
        f"arithmetic limit: {count} vector operations of {lanes} float64, two a cycle at {ghz:.2f} GHz: {limit_ns:.0f} ns; "
        f"measured {measured_ns / limit_ns:.1f} times that"
    ]
