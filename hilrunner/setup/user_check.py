"""A protection of the user's own: a function in a Python file, compiled for the period, called by its address.

    def check(data, length, counter, sent):
        # data: the frame's bytes, uint8[64]; length: how many of them are sent
        # counter: of the frame before in this stream, -1 before the first; sent: 1 the bench sends, 0 it has received
        if sent:
            data[7] = ...          # write counter and checksum
            return (counter + 1) % 16
        return counter_of_frame    # or -1: checksum wrong, -2: counter repeated, -3: frames lost

The file is attached to the log, so that a replay compiles the same function. A log may come from anywhere, so the file may hold
functions and constants only: nothing of it runs but what the compiler made of the functions, which can reach no file, no module and
no byte outside the frame.
"""

import ast
import ctypes
import hashlib
from collections.abc import Callable

import msgspec
import numpy as np

from hilrunner.base.errors import DbcError, HilrunnerError
from hilrunner.setup.mapping import AxisMapping

ReadOwn = Callable[[str], bytes]
_ARGUMENTS = ("data", "length", "counter", "sent")
_FORBIDDEN = (
    ast.Raise, ast.Try, ast.With, ast.Yield, ast.YieldFrom, ast.Await, ast.Assert, ast.Global, ast.Nonlocal, ast.JoinedStr,
    ast.Import, ast.ImportFrom, ast.Lambda, ast.ClassDef, ast.AsyncFunctionDef, ast.List, ast.Dict, ast.Set, ast.ListComp,
    ast.SetComp, ast.DictComp, ast.GeneratorExp, ast.Delete, ast.While,
)  # fmt: skip
_BUILTINS = {"range": range, "len": len, "int": int, "min": min, "max": max, "abs": abs, "bool": bool, "divmod": divmod}
_SIZE = 64
_kept: dict[tuple[str, str], object] = {}  # what the addresses point at must live as long as the process


def split_name(named: object) -> tuple[str, str] | None:
    """(file, function) of `file.py:function`; None for anything else."""
    if not isinstance(named, str):
        return None
    file, colon, function = named.rpartition(":")
    return (file, function) if colon and file.endswith(".py") and function.isidentifier() else None


def with_own_files(mapping: AxisMapping, keep: Callable[[str], str]) -> AxisMapping:
    """The mapping with each file of the user's own under the name that `keep` gives it."""

    def renamed(entry):
        parts = split_name(entry.protection)
        return entry if parts is None else msgspec.structs.replace(entry, protection=f"{keep(parts[0])}:{parts[1]}")

    command = renamed(mapping.command)
    command = msgspec.structs.replace(command, frames=[renamed(one) for one in command.frames])
    return AxisMapping(command, [renamed(one) for one in mapping.measurements])


def user_address(where: str, named: str, read_own: ReadOwn) -> int:
    """Address of the compiled function; DbcError where it cannot be found, compiled, or would not hold the house rules."""
    parts = split_name(named)
    if parts is None:
        raise DbcError(
            where, f"protection '{named}' is not known", "dbc, none, file.py:function, or a table with a profile"
        )
    try:
        source = read_own(parts[0])
    except OSError as error:
        remedy = "name a file beside the profile"
        raise DbcError(f"{where}: {parts[0]}", f"cannot be read ({error.strerror})", remedy=remedy) from None
    key = (hashlib.sha256(source).hexdigest(), parts[1])
    if key not in _kept:
        _kept[key] = _compiled(f"{where}: {named}", source, parts[1])
    return _address(_kept[key])


def _compiled(where: str, source: bytes, name: str):
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise DbcError(where, f"is no Python file: {error}", remedy="correct the file") from None
    _check_tree(where, tree, name)
    namespace: dict = {"__builtins__": _BUILTINS, "__name__": "own_protection"}
    try:
        exec(compile(tree, "own protection", "exec"), namespace)  # functions and literals only, see _check_tree
        return _callable(namespace[name])
    except HilrunnerError:
        raise
    except Exception as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        limit = f"a function of ({', '.join(_ARGUMENTS)})"
        raise DbcError(where, f"cannot be compiled: {first}", limit, "correct it") from None


def _check_tree(where: str, tree: ast.Module, name: str) -> None:
    """Functions and literal constants at the top; inside, arithmetic, loops over a range, comparisons, calls of its own."""
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    if name not in functions:
        raise DbcError(
            where, f"the file defines no function '{name}'", ", ".join(functions) or "none", "correct the name"
        )
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            _check_function(where, node, {key for key, one in functions.items() if one.lineno < node.lineno})
        elif not _is_constant(node):
            _refuse(where, node, "is neither a function nor a constant", "functions, numbers, tuples of numbers")


def _is_constant(node: ast.stmt) -> bool:
    """A text that says something, or a name for a literal."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return False
    try:
        ast.literal_eval(node.value)
    except (ValueError, TypeError, SyntaxError):
        return False
    return True


def _check_function(where: str, function: ast.FunctionDef, earlier: set[str]) -> None:
    """Refuse what could leave the frame; only functions that stand above may be called, so that nothing calls itself."""
    if function.decorator_list or function.args.defaults or any(function.args.kw_defaults):
        _refuse(where, function, "has a decorator or a default value")
    for node in ast.walk(function):
        if isinstance(node, _FORBIDDEN):
            _refuse(where, node, f"{type(node).__name__.lower()} cannot run inside a period")
        if isinstance(node, ast.Attribute) or (isinstance(node, ast.Name) and node.id.startswith("__")):
            _refuse(where, node, "reaches into an object")
        called = node.func if isinstance(node, ast.Call) else None
        if called is not None and not (isinstance(called, ast.Name) and called.id in earlier | _BUILTINS.keys()):
            _refuse(where, node, f"calls something that is neither a function above it nor {', '.join(_BUILTINS)}")


def _refuse(where: str, node: ast.AST, what: str, limit: str = "arithmetic, comparisons, loops over a range") -> None:
    line = getattr(node, "lineno", 0)
    raise DbcError(where, f"line {line}: {what}", limit, "return -1 where a frame is wrong")


def _callable(function):
    from numba import carray, cfunc, config, njit, types

    if config.DISABLE_JIT:
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)

        def interpreted(data, length, counter, sent):
            view = np.ctypeslib.as_array((ctypes.c_uint8 * _SIZE).from_address(data))
            return int(function(view, length, counter, sent))

        return kind(interpreted)
    for name, one in list(function.__globals__.items()):
        if callable(one) and name not in _BUILTINS and name != function.__name__:
            function.__globals__[name] = njit(nogil=True, error_model="numpy", boundscheck=True)(one)
    inner = njit(nogil=True, error_model="numpy", boundscheck=True)(function)
    signature = types.int64(types.CPointer(types.uint8), types.int64, types.int64, types.int64)

    @cfunc(signature, nopython=True, error_model="numpy")
    def call(data, length, counter, sent):
        return inner(carray(data, (_SIZE,)), length, counter, sent)

    return call


def _address(kept) -> int:
    if hasattr(kept, "address"):
        return int(kept.address)
    return int(ctypes.cast(kept, ctypes.c_void_p).value)
