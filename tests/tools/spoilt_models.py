"""Model files spoilt at random: bytes flipped, cut, or fields of the protobuf changed to what no exporter writes."""

import numpy as np
import onnx

_TEXTS = ("", "\x1b[31m", "a" * 3000, "nan", "[" * 500, "{}", "[]", "null", '[{"role": 1}]', "1e999")


def spoilt(data: bytes, drawn: np.random.Generator) -> bytes:
    """One spoilt version of an ONNX file."""
    if drawn.random() < 0.5:
        return _damaged(data, drawn)
    model = onnx.ModelProto.FromString(data)
    for _ in range(int(drawn.integers(1, 4))):
        _CHANGES[int(drawn.integers(len(_CHANGES)))](model, drawn)
    return model.SerializeToString()


def _damaged(data: bytes, drawn: np.random.Generator) -> bytes:
    spoilt = bytearray(data)
    if drawn.random() < 0.2:
        return bytes(spoilt[: int(drawn.integers(1, len(spoilt)))])
    for place in drawn.integers(0, len(spoilt), int(drawn.integers(1, 9))):
        spoilt[place] ^= 1 << int(drawn.integers(8))
    return bytes(spoilt)


def _one(items, drawn):
    """One of them; of none, a new one."""
    return items[int(drawn.integers(len(items)))] if len(items) else items.add()


def _change_text(model, drawn) -> None:
    _one(model.metadata_props, drawn).value = str(drawn.choice(_TEXTS))


def _change_shape(model, drawn) -> None:
    tensor = _one(model.graph.initializer, drawn)
    tensor.dims[:] = [int(n) for n in drawn.choice([0, 1, 2, 10, -1, 1 << 40], int(drawn.integers(0, 4)))]


def _change_type(model, drawn) -> None:
    _one(model.graph.initializer, drawn).data_type = int(drawn.integers(0, 24))


def _change_numbers(model, drawn) -> None:
    tensor = _one(model.graph.initializer, drawn)
    if tensor.raw_data:
        values = np.frombuffer(tensor.raw_data, np.float64).copy() if len(tensor.raw_data) % 8 == 0 else np.zeros(1)
        values[: len(values) // 2 + 1] = drawn.choice([np.nan, np.inf, 1e308, -1e308, 5e-324])
        tensor.raw_data = values.tobytes()


def _change_node(model, drawn) -> None:
    node = _one(model.graph.node, drawn)
    node.op_type = str(
        drawn.choice(["Softmax", "Conv", "Reshape", "Transpose", "Loop", "MatMul", "Cast", "LayerNormalization", ""])
    )


def _rewire(model, drawn) -> None:
    node, other = _one(model.graph.node, drawn), _one(model.graph.node, drawn)
    if node.input and other.output:
        node.input[int(drawn.integers(len(node.input)))] = other.output[0]


def _drop(model, drawn) -> None:
    items = [model.graph.node, model.graph.initializer, model.graph.input, model.graph.output, model.opset_import]
    chosen = items[int(drawn.integers(len(items)))]
    if len(chosen):
        del chosen[int(drawn.integers(len(chosen)))]


def _change_input(model, drawn) -> None:
    kind = _one(model.graph.input, drawn).type.tensor_type
    kind.elem_type = int(drawn.choice([1, 7, 8, 11, 16, 0]))
    del kind.shape.dim[:]
    for size in drawn.choice([0, 1, 3, 5, 1 << 40], int(drawn.integers(0, 4))):
        kind.shape.dim.add().dim_value = int(size)


_CHANGES = (_change_text, _change_shape, _change_type, _change_numbers, _change_node, _rewire, _drop, _change_input)
