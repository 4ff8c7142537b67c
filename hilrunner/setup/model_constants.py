"""The numbers of an ONNX graph: initialisers, every form of Constant, and what nodes make of constants alone.

Exporters leave such nodes behind: torch an Identity where two biases are equal, a Transpose or a Cast on a weight. They are worked out once,
when the file is read, with a budget: a small file must not make large numbers.
"""

import math

import numpy as np

from hilrunner.base.errors import ModelError

ELEMENTS_MAX = 8_000_000  # of one constant, and of all that nodes make of constants: 64 MB of float64
_SHAPED = ("Reshape", "Squeeze", "Unsqueeze", "Flatten")
_BINARY = {"Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide, "Pow": np.power}
_UNARY = {"Neg": np.negative, "Sqrt": np.sqrt, "Reciprocal": np.reciprocal, "Exp": np.exp, "Abs": np.abs}
_FORMS = {"value_float": "f", "value_floats": "floats", "value_int": "i", "value_ints": "ints"}


def constants_of(place: str, model) -> dict[str, np.ndarray]:
    """Every value of the main graph that does not depend on its inputs, by name; ModelError where one is damaged or too large."""
    found = {tensor.name: to_array(place, tensor) for tensor in model.graph.initializer}
    budget = ELEMENTS_MAX
    for index, node in enumerate(model.graph.node):
        if len(node.output) != 1:
            continue
        if node.op_type == "Constant":
            value = _constant(place, node)
        elif node.input and all(name in found for name in node.input if name):
            value = _worked_out(node, [found[name] if name else None for name in node.input], budget)
        else:
            continue
        if value is None:
            continue
        budget -= value.size
        if budget < 0:
            raise ModelError(
                f"{place}: node {index}, {node.op_type}", "makes more constants than a network needs",
                f"at most {ELEMENTS_MAX} numbers", "a smaller network",
            )  # fmt: skip
        found[node.output[0]] = value
    return found


def to_array(place: str, tensor) -> np.ndarray:
    """The numbers of a tensor; ModelError for texts, for sizes that disagree with its shape, and for giants."""
    from onnx import TensorProto, numpy_helper

    where = f"{place}: constant '{tensor.name[:80]}'"
    count = math.prod(tensor.dims)
    if min(tensor.dims, default=0) < 0 or count > ELEMENTS_MAX:
        raise ModelError(
            where, f"has shape {list(tensor.dims)[:8]}", f"at most {ELEMENTS_MAX} numbers", "a smaller network"
        )
    if tensor.data_type == TensorProto.STRING:
        raise ModelError(where, "holds texts", "numbers", "export the network alone")
    try:
        value = numpy_helper.to_array(tensor)
    except Exception as error:  # ValueError, TypeError, KeyError, by the kind of damage
        raise ModelError(where, f"is damaged: {str(error).splitlines()[0][:200]}", remedy="export it again") from error
    if value.dtype.kind not in "fiub" and "float" not in value.dtype.name:
        raise ModelError(where, f"has type {value.dtype.name}", "real numbers", "export the network alone")
    return value


def numbers(value: np.ndarray) -> np.ndarray:
    """As float64."""
    return np.asarray(value).astype(np.float64)


def _constant(place: str, node) -> np.ndarray | None:
    if len(node.attribute) != 1:
        return None
    attribute = node.attribute[0]
    if attribute.name == "value":
        return to_array(place, attribute.t)
    field = _FORMS.get(attribute.name)
    if field is None:
        return None
    value = getattr(attribute, field)
    return np.array(value if field in ("f", "i") else list(value), np.float32 if field[0] == "f" else np.int64)


def _worked_out(node, values: list, budget: int) -> np.ndarray | None:
    """What a node makes of constants; None for one that is not worked out here."""
    kind, attributes = node.op_type, {one.name: one for one in node.attribute}
    try:
        with np.errstate(all="ignore"):
            if kind in ("Identity", "Dropout"):
                return values[0]
            if kind in ("Cast", "CastLike"):  # kept as exact as it is stored: the port computes in float64
                return values[0]
            if kind == "Transpose":
                order = list(attributes["perm"].ints) if "perm" in attributes else None
                return np.transpose(values[0], order)
            if kind in _SHAPED:
                return _shaped(kind, values, attributes)
            if kind in _BINARY and len(values) == 2:
                if math.prod(np.broadcast_shapes(values[0].shape, values[1].shape)) > budget:
                    return None
                return _BINARY[kind](numbers(values[0]), numbers(values[1]))
            if kind in _UNARY:
                return _UNARY[kind](numbers(values[0]))
            if kind == "Concat":
                return np.concatenate(values, axis=attributes["axis"].i)
    except (ValueError, IndexError, KeyError, TypeError, OverflowError):  # what the node says cannot be done
        return None
    return None


def _shaped(kind: str, values: list, attributes: dict) -> np.ndarray | None:
    value = values[0]
    if kind == "Flatten":
        axis = attributes["axis"].i if "axis" in attributes else 1
        return value.reshape(math.prod(value.shape[:axis]), -1)
    given = values[1] if len(values) > 1 and values[1] is not None else None
    if kind == "Reshape":
        wanted = [int(n) for n in given]
        return value.reshape([value.shape[i] if n == 0 else n for i, n in enumerate(wanted)])
    axes = [int(n) for n in given] if given is not None else [int(n) for n in attributes["axes"].ints]
    if kind == "Unsqueeze":
        return np.expand_dims(value, tuple(axes))
    return np.squeeze(value, tuple(axes))
