"""Files and functions stay short enough to be read in one go. The function rule is a ratchet: old long ones may only shrink."""

from tests.rules import tree

FILE_LINES_MAX = 500
FUNCTION_LINES_MAX = 70
# path:function → lines it may have; when one is cut, lower or remove its entry (a test says so)
LONGER_FUNCTIONS: dict[str, int] = {}


def test_no_source_file_is_longer_than_the_limit():
    sources = [p for p in tree.project_files() if p.suffix in (".c", ".h", ".sh")] + list(tree.python_files())
    assert len(sources) > 20
    counts = {tree.relative(p): len(tree.text_of(p).splitlines()) for p in sources}
    assert {name: count for name, count in counts.items() if count > FILE_LINES_MAX} == {}


def test_no_function_is_longer_than_the_limit():
    too_long = {}
    for function in tree.functions():
        key = f"{function.path}:{function.name}"
        if function.line_count > LONGER_FUNCTIONS.get(key, FUNCTION_LINES_MAX):
            too_long[key] = function.line_count
    assert too_long == {}


def test_the_ratchet_only_tightens():
    lengths = {f"{f.path}:{f.name}": f.line_count for f in tree.functions()}
    for key, allowed in LONGER_FUNCTIONS.items():
        assert lengths.get(key, 0) == allowed, f"{key} has {lengths.get(key, 0)} lines now: lower or remove its entry"
        assert allowed > FUNCTION_LINES_MAX
