"""The rooms keep their direction (contracts in pyproject.toml), and the command line starts without the heavy libraries."""

import ast
import subprocess
import sys

from tests.rules import tree


def test_import_contracts_hold():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from importlinter.cli import lint_imports_command; lint_imports_command()",
            "--no-cache",
        ],
        cwd=tree.ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_help_and_version_need_no_heavy_library():
    program = (
        "import sys; from hilrunner.cli import main; main(['--help']); main(['--version']); "
        "heavy = {'numpy', 'numba', 'can', 'onnxruntime', 'matplotlib', 'torch'} & set(sys.modules); "
        "sys.exit(f'imported for --help: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage: hilrunner" in done.stdout


def _imported_roots(path):
    for node in ast.walk(ast.parse(tree.text_of(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0]


def test_firmware_interface_stands_alone():
    """A firmware team can take the folder: nothing in it imports or includes anything of ours."""
    for path in tree.project_files():
        name = tree.relative(path)
        if not name.startswith("firmware_iface/"):
            continue
        if path.suffix == ".py":
            assert "hilrunner" not in set(_imported_roots(path)), name
        if path.suffix in (".c", ".h"):
            for line in tree.text_of(path).splitlines():
                assert not (line.startswith("#include") and ".." in line), f"{name}: {line}"


def test_no_process_of_the_product_looks_for_modules_in_the_working_folder():
    """`python -m` and `python -c` look there first, and would run a signal.py or can.py that a user keeps."""
    found = {}
    for path in tree.python_files():
        if not tree.relative(path).startswith("hilrunner/"):
            continue
        for node in ast.walk(ast.parse(tree.text_of(path))):
            words = [ast.unparse(word) for word in node.elts] if isinstance(node, ast.List) else []
            for word, following in zip(words, words[1:], strict=False):
                if word.endswith("sys.executable") or word == "os.path.realpath(sys.executable)":
                    found[f"{tree.relative(path)}:{node.lineno}"] = following
    assert found, "the rule looks for nothing"
    safe = ("'-P'", "'-I'", "str(Path(__file__)")
    assert {place: word for place, word in found.items() if not word.startswith(safe)} == {}


def test_nothing_of_the_product_imports_tools_or_tests():
    for path in tree.python_files():
        name = tree.relative(path)
        if name.startswith("hilrunner/"):
            assert not {"tools", "tests"}.intersection(_imported_roots(path)), name
