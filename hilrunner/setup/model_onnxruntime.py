"""onnxruntime in the loop: a session bound once to fixed buffers, run through its C function without the interpreter.

The shared library of the Python package exports onnxruntime's C API (`OrtGetApiBase`), a table of functions whose order
never changes; `RunWithBinding(session, run_options, binding)` is all the period needs. Where the library cannot be found
a Python callback with the same signature stands in: it works, takes the interpreter's lock, and says so.

The period only learns that a call failed (its outputs become NaN, and the run stops); `reasons` has onnxruntime's words.
"""

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilrunner.base.errors import ModelError
from hilrunner.plant.foreign_call import (
    FOREIGN_BINDING,
    FOREIGN_FUNCTION,
    FOREIGN_INPUT,
    FOREIGN_OPTIONS,
    FOREIGN_OUTPUT,
    FOREIGN_SESSION,
    FOREIGN_SINGLE,
    FOREIGN_SIZE,
)
from hilrunner.plant.network import Mlp
from hilrunner.plant.step import AxisPlant
from hilrunner.setup.model_probe import probe
from hilrunner.setup.model_rows import Rows, one_row, rows_of

_API_VERSION = 5  # the first with IoBinding
# places in OrtApi (onnxruntime_c_api.h: members are only ever appended)
_GET_ERROR_MESSAGE = 2
_CREATE_ENV = 3
_CREATE_SESSION_FROM_ARRAY = 8
_CREATE_SESSION_OPTIONS = 10
_SET_INTRA_OP_THREADS = 24
_SET_INTER_OP_THREADS = 25
_CREATE_RUN_OPTIONS = 39
_CREATE_TENSOR_WITH_DATA = 49
_CREATE_CPU_MEMORY_INFO = 69
_RELEASE_STATUS = 93
_RUN_WITH_BINDING = 133
_CREATE_IO_BINDING = 134
_BIND_INPUT = 136
_BIND_OUTPUT = 137
_LOG_ERROR = 3
_ELEMENT_FLOAT, _ELEMENT_DOUBLE = 1, 11
_RUN_KIND = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


class _Library:
    """The C API; every call that returns a status is checked."""

    def __init__(self, path: Path) -> None:
        library = ctypes.CDLL(str(path))
        base = library.OrtGetApiBase
        base.restype = ctypes.POINTER(ctypes.c_void_p)
        get_api = ctypes.CFUNCTYPE(ctypes.POINTER(ctypes.c_void_p), ctypes.c_uint32)(base()[0])
        self.table = get_api(_API_VERSION)
        if not self.table:
            raise OSError("no C API of version 5")

    def address(self, place: int) -> int:
        """Address of one function of the table."""
        return self.table[place]

    def call(self, place: int, *arguments) -> None:
        """Call a function that returns OrtStatus*; OSError with onnxruntime's words if it fails."""
        kinds = [
            type(argument) if isinstance(argument, ctypes._SimpleCData) else ctypes.c_void_p for argument in arguments
        ]
        status = ctypes.CFUNCTYPE(ctypes.c_void_p, *kinds)(self.table[place])(*arguments)
        if status:
            message = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p)(self.table[_GET_ERROR_MESSAGE])(status)
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(self.table[_RELEASE_STATUS])(status)
            raise OSError(message.decode(errors="replace"))

    def make(self, place: int, *arguments) -> ctypes.c_void_p:
        """Call a function whose last argument receives a handle; the handle."""
        handle = ctypes.c_void_p()
        self.call(place, *arguments, ctypes.byref(handle))
        return handle


@dataclass
class Bound:
    """One network's session: what the addresses point to, and why its calls failed."""

    role: str
    why: Callable[[], str]  # onnxruntime's words, empty where nothing failed
    kept: object  # lives as long as the addresses are used


def reasons(bound: list[Bound] | None) -> list[str]:
    """Why calls of these networks failed, one sentence a network that did; None: no network runs by onnxruntime."""
    told = [(one.role, one.why()) for one in bound or []]
    return [f"network '{role}': onnxruntime: {words}" for role, words in told if words]


def engine_errors(names: list[str], plants: list[AxisPlant]) -> list[str]:
    """Why the networks of a bench failed, told after a run; empty for other engines."""
    found = []
    for name, plant in zip(names, plants, strict=True):
        bound = None if plant.networks is None else plant.networks.keep_alive
        found += [f"axis {name}: {words}" for words in reasons(bound)]
    return found


def library_path() -> Path | None:
    """The onnxruntime library of the installed package that exports the C API."""
    import onnxruntime

    folder = Path(onnxruntime.__file__).parent / "capi"
    found = sorted(
        [*folder.glob("libonnxruntime.so*"), *folder.glob("libonnxruntime*.dylib"), *folder.glob("onnxruntime.dll")]
    )
    return found[0] if found else None


@dataclass(frozen=True)
class Part:
    """What one network needs of a file: an ONNX file with one input and one output."""

    data: bytes
    rows: Rows
    output: str
    output_shape: tuple[int, ...]  # of one row as the file tells it; empty: it does not


def bind(
    place: str, data: bytes, networks: dict[str, Mlp], text, trusted: bool = False
) -> tuple[dict[str, Mlp], list[Bound]]:
    """The same networks, each with the addresses of its own bound session.

    Args:
        data: bytes of the ONNX file.
        networks: opaque networks (ends only) by role.
        text: model_text.ModelText.
        trusted: the file's own data sheet vouches for it; any other is tried in a process of its own first (model_probe).

    Returns:
        (networks with `foreign` set, what their addresses point to).

    Raises:
        ModelError: onnxruntime refuses the model or one of its types.
    """
    bindings: list[Bound] = []
    bound = {}
    path = library_path()
    for network in text.networks:
        part = part_of(place, data, network)
        one_row(place, part.rows)
        mlp = networks[network.role]
        names = (part.rows.name, part.output)
        single = part.rows.kind == np.float32
        shapes = part.rows.shape(1), part.output_shape
        if not trusted or not part.output_shape:
            shapes = shapes[0], tuple(probe(place, network.role, part.data, shapes[0], single, names))
        if math.prod(shapes[1]) != mlp.output_count:
            raise ModelError(
                f"{place}: network '{network.role}'",
                f"answers {math.prod(shapes[1])} numbers, its metadata names {mlp.output_count}", "the same number",
            )  # fmt: skip
        buffers = np.zeros(shapes[0], part.rows.kind), np.zeros(shapes[1], part.rows.kind)
        try:
            make = _bind_python if path is None else _bind_c
            addresses, why, kept = make(path, part.data, names, buffers)
        except OSError as error:
            raise ModelError(place, f"onnxruntime refuses network '{network.role}': {error}") from error
        addresses[FOREIGN_SINGLE] = single
        bindings.append(Bound(network.role, why, (kept, buffers)))
        bound[network.role] = replace(mlp, foreign=addresses)
    return bound, bindings


def part_of(place: str, data: bytes, network) -> Part:
    """The file reduced to what one output needs; ModelError where that is more than one input, or of a foreign type."""
    import onnx
    from onnx import TensorProto

    model = onnx.ModelProto.FromString(data)
    constants = {tensor.name for tensor in model.graph.initializer}
    outputs = {value.name: value for value in model.graph.output}
    output = network.output or next(iter(outputs))
    if output not in outputs:
        raise ModelError(place, f"has no output '{output}'", ", ".join(outputs))
    used, kept = _needed(model.graph.node, output)
    inputs = [value for value in model.graph.input if value.name in used and value.name not in constants]
    if len(inputs) != 1:
        raise ModelError(place, f"output '{output}' needs {len(inputs)} inputs", "one input a network")
    nodes = [node for index, node in enumerate(model.graph.node) if index in kept]
    tensors = [tensor for tensor in model.graph.initializer if tensor.name in used]
    graph = onnx.helper.make_graph(nodes, model.graph.name, inputs, [outputs[output]], tensors)
    reduced = onnx.helper.make_model(graph, opset_imports=model.opset_import, functions=model.functions)
    reduced.ir_version = model.ir_version
    kind = inputs[0].type.tensor_type
    element = TensorProto.DataType.Name(kind.elem_type).lower() if kind.elem_type else "undefined"
    rows = rows_of(place, inputs[0].name, element, _sizes(kind), len(network.inputs))
    answer = _sizes(outputs[output].type.tensor_type)
    told = len(answer) > 1 and all(isinstance(size, int) for size in answer[1:])
    return Part(reduced.SerializeToString(), rows, output, (1, *answer[1:]) if told else ())


def _sizes(kind) -> list:
    """Sizes of a tensor type: numbers, and names where they are free."""
    return [one.dim_value if one.dim_value > 0 else one.dim_param or "?" for one in kind.shape.dim]


def _needed(nodes, output: str) -> tuple[set[str], set[int]]:
    """Names and nodes that an output depends on, those that subgraphs name as well."""
    makers = {name: index for index, node in enumerate(nodes) for name in node.output}
    wanted, used, kept = [output], set(), set()
    while wanted:
        name = wanted.pop()
        used.add(name)
        if name in makers and makers[name] not in kept:
            kept.add(makers[name])
            inner = [nodes[makers[name]]]
            while inner:
                node = inner.pop()
                wanted += [source for source in node.input if source and source not in used]
                for attribute in node.attribute:
                    graphs = [*attribute.graphs, *([attribute.g] if attribute.HasField("g") else [])]
                    inner += [one for graph in graphs for one in graph.node]
                    wanted += [value.name for graph in graphs for value in graph.output if value.name not in used]
    return used, kept


_shared: dict[str, tuple[_Library, ctypes.c_void_p]] = {}


def _environment(path: Path) -> tuple[_Library, ctypes.c_void_p]:
    if str(path) not in _shared:
        library = _Library(path)
        env = library.make(_CREATE_ENV, ctypes.c_int(_LOG_ERROR), ctypes.c_char_p(b"hilrunner"))
        _shared[str(path)] = library, env
    return _shared[str(path)]


def _bind_c(path: Path, part: bytes, names: tuple[str, str], buffers: tuple) -> tuple[np.ndarray, Callable, object]:
    library, env = _environment(path)
    options = library.make(_CREATE_SESSION_OPTIONS)
    library.call(_SET_INTRA_OP_THREADS, options, ctypes.c_int(1))
    library.call(_SET_INTER_OP_THREADS, options, ctypes.c_int(1))
    data = ctypes.create_string_buffer(part, len(part))
    session = library.make(
        _CREATE_SESSION_FROM_ARRAY, env, ctypes.cast(data, ctypes.c_void_p), ctypes.c_size_t(len(part)), options
    )
    run_options = library.make(_CREATE_RUN_OPTIONS)
    memory = library.make(_CREATE_CPU_MEMORY_INFO, ctypes.c_int(1), ctypes.c_int(0))
    binding = library.make(_CREATE_IO_BINDING, session)
    for place, name, buffer in zip((_BIND_INPUT, _BIND_OUTPUT), names, buffers, strict=True):
        shape = (ctypes.c_int64 * buffer.ndim)(*buffer.shape)
        element = _ELEMENT_FLOAT if buffer.dtype == np.float32 else _ELEMENT_DOUBLE
        value = library.make(
            _CREATE_TENSOR_WITH_DATA, memory, ctypes.c_void_p(buffer.ctypes.data), ctypes.c_size_t(buffer.nbytes),
            ctypes.cast(shape, ctypes.c_void_p), ctypes.c_size_t(buffer.ndim), ctypes.c_int(element),
        )  # fmt: skip
        library.call(place, binding, ctypes.c_char_p(name.encode()), value)
    addresses = np.zeros(FOREIGN_SIZE, np.int64)
    addresses[FOREIGN_FUNCTION] = library.address(_RUN_WITH_BINDING)
    addresses[FOREIGN_SESSION] = session.value
    addresses[FOREIGN_OPTIONS] = run_options.value
    addresses[FOREIGN_BINDING] = binding.value
    addresses[FOREIGN_INPUT] = buffers[0].ctypes.data
    addresses[FOREIGN_OUTPUT] = buffers[1].ctypes.data

    def why() -> str:
        """The status of a call is gone with the period it failed in: call again with what lies in the buffers."""
        try:
            library.call(_RUN_WITH_BINDING, session, run_options, binding)
        except OSError as error:
            return _first_line(error)
        return ""

    return addresses, why, data


def _bind_python(
    _path: None, part: bytes, names: tuple[str, str], buffers: tuple
) -> tuple[np.ndarray, Callable, object]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(part, options, providers=["CPUExecutionProvider"])
        binding = session.io_binding()
        for bind_one, name, buffer in zip((binding.bind_input, binding.bind_output), names, buffers, strict=True):
            bind_one(name, "cpu", 0, buffer.dtype.type, buffer.shape, buffer.ctypes.data)
    except Exception as error:  # onnxruntime's error classes have no common base but Exception
        raise OSError(_first_line(error)) from error
    failed: list[str] = []

    def run(session_handle, options_handle, binding_handle):
        try:
            session.run_with_iobinding(binding)
        except Exception as error:  # nothing may escape into compiled code: a status says it
            if not failed:
                failed.append(_first_line(error))
            return 1
        return 0

    def why() -> str:
        """The first failure."""
        return failed[0] if failed else ""

    callback = _RUN_KIND(run)
    addresses = np.zeros(FOREIGN_SIZE, np.int64)
    addresses[FOREIGN_FUNCTION] = ctypes.cast(callback, ctypes.c_void_p).value
    addresses[FOREIGN_INPUT] = buffers[0].ctypes.data
    addresses[FOREIGN_OUTPUT] = buffers[1].ctypes.data
    return addresses, why, (session, binding, callback)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
