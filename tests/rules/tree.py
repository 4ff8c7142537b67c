"""What the rule tests look at: the project's own files, and the functions in them."""

import ast
import subprocess
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
_NOT_OURS = {
    ".git",
    ".venv",
    "build",
    "dist",
    "runs",
    "__pycache__",
    ".cache",
    ".pytest_cache",
    ".ruff_cache",
    ".hypothesis",
}


class Function(NamedTuple):
    """One function definition."""

    path: str  # relative to the project
    name: str  # qualified: Class.method, outer.inner
    node: ast.FunctionDef
    line_count: int
    decorators: tuple[str, ...]


@cache
def project_files() -> tuple[Path, ...]:
    """Every file of the project: tracked, or new and not ignored; a plain walk where there is no git."""
    listing = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True, text=True
    )
    if listing.returncode == 0 and listing.stdout:
        names = listing.stdout.split("\0")
        return tuple(ROOT / name for name in sorted(set(names)) if name and (ROOT / name).is_file())
    found = [p for p in ROOT.rglob("*") if p.is_file() and not _NOT_OURS.intersection(p.relative_to(ROOT).parts)]
    return tuple(sorted(found))


@cache
def text_of(path: Path) -> str | None:
    """The file's text, or None for a binary file."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return None


def relative(path: Path) -> str:
    """Path relative to the project, as messages show it."""
    return str(path.relative_to(ROOT))


@cache
def python_files() -> tuple[Path, ...]:
    """Python sources, those without a suffix (tools) included."""
    files = []
    for path in project_files():
        text = text_of(path) if path.suffix in (".py", "") else None
        if text is not None and (path.suffix == ".py" or text.startswith("#!/usr/bin/env python3")):
            files.append(path)
    return tuple(files)


@cache
def functions() -> tuple[Function, ...]:
    """Every function definition in the project's Python files."""
    found: list[Function] = []
    for path in python_files():
        _collect(ast.parse(text_of(path)), relative(path), "", found)
    return tuple(found)


def _collect(node: ast.AST, path: str, prefix: str, found: list[Function]) -> None:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            name = prefix + child.name
            decorators = tuple(ast.unparse(decorator) for decorator in child.decorator_list)
            found.append(Function(path, name, child, child.end_lineno - child.lineno + 1, decorators))
            _collect(child, path, name + ".", found)
        elif isinstance(child, ast.ClassDef):
            _collect(child, path, prefix + child.name + ".", found)
        else:
            _collect(child, path, prefix, found)


def hot_functions() -> tuple[Function, ...]:
    """Functions that run inside a period: decorated with `hot` or `entry` of base.compiled."""
    return tuple(
        f
        for f in functions()
        if f.path.startswith("hilrunner/") and {"hot", "inlined", "folded", "entry"}.intersection(f.decorators)
    )
