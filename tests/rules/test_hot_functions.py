"""House rules of everything that runs inside a period, checked in the source: no exception, no print, no allocation, no objects."""

import ast

from tests.rules import tree

ALLOCATORS = {
    "array", "zeros", "zeros_like", "empty", "empty_like", "ones", "full", "arange", "linspace", "concatenate",
    "stack", "vstack", "hstack", "copy", "dot", "matmul", "append", "sort", "argsort", "where", "list", "dict", "set",
    "print", "str", "open", "bytes", "isinstance", "getattr",
}  # fmt: skip
OFFLINE = "hilrunner/plant/ida"  # the offline solver is compiled too, and may allocate
FORBIDDEN_NODES = (
    ast.Raise, ast.Try, ast.With, ast.Yield, ast.YieldFrom, ast.Await, ast.JoinedStr, ast.ListComp, ast.SetComp, ast.DictComp,
    ast.GeneratorExp, ast.List, ast.Dict, ast.Set, ast.Lambda, ast.Global, ast.Nonlocal, ast.Import, ast.ImportFrom,
)  # fmt: skip


def offences(function: ast.FunctionDef) -> list[str]:
    """What a hot function must not contain, each as `line: what`."""
    found = []
    body = function.body
    if (
        isinstance(body[0], ast.Expr)
        and isinstance(body[0].value, ast.Constant)
        and isinstance(body[0].value.value, str)
    ):
        body = body[1:]
    names = {id(node.slice) for statement in body for node in ast.walk(statement) if isinstance(node, ast.Subscript)}
    for statement in body:
        for node in ast.walk(statement):
            if isinstance(node, FORBIDDEN_NODES):
                found.append(f"{node.lineno}: {type(node).__name__}")
            elif isinstance(node, ast.Call):
                called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
                if called in ALLOCATORS:
                    found.append(f"{node.lineno}: call of {called}")
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in names:
                found.append(f"{node.lineno}: string {node.value!r}")
    return found


def test_hot_functions_keep_the_house_rules():
    hot = tree.hot_functions()
    assert len(hot) > 40
    bad = {
        f"{f.path}:{f.name}": offences(f.node)
        for f in hot
        if f.path.startswith(("hilrunner/realtime/", "hilrunner/plant/")) and not f.path.startswith(OFFLINE)
    }
    assert {name: found for name, found in bad.items() if found} == {}


def test_the_rules_find_planted_offences():
    planted = """
def f(x, rec):
    "docstring"
    y = np.zeros(3)
    if x < 0:
        raise ValueError
    print(x)
    z = [x, x]
    rec["field"] = 1.0
    name = "text"
"""
    found = offences(ast.parse(planted).body[0])
    assert sorted(line.partition(": ")[2] for line in found) == [
        "List", "Raise", "call of print", "call of zeros", "string 'text'",
    ]  # fmt: skip


def test_every_compiled_function_uses_the_project_decorators():
    """One place decides how code is compiled (no fast-math, no GIL): `base.compiled`."""
    for function in tree.functions():
        if function.path.startswith("hilrunner/") and function.path != "hilrunner/base/compiled.py":
            foreign = [
                d for d in function.decorators if d.partition("(")[0] in ("njit", "jit", "numba.njit", "numba.jit")
            ]
            assert foreign == [], f"{function.path}:{function.name}: {foreign}"
