"""Words that must not be left in the project: markers of unfinished work, and paths or hosts of one machine."""

import re

import pytest

from tests.rules import tree

# put together from pieces, so that this file passes its own test
UNFINISHED = [a + b for a, b in (("TO", "DO"), ("FIX", "ME"), ("XX", "X"), ("Not", "ImplementedError"), ("HA", "CK"))]
MACHINE_PATHS = [r"(?<![\w.])/" + name + "/" for name in ("wo" + "rk", "ro" + "ot", "opt/py" + "pi", "opt/whe" + "els")]
MACHINE_PATHS += [r"(?<![\w.])/home/(?!me\b|user\b|\$|<)\w+"]
TESTS_LEFT_OUT = [r"pytest\.mark\." + "x" + "fail", r"pytest\." + "x" + r"fail\("]


def _hits(patterns, files):
    joined = re.compile("|".join(patterns))
    found = []
    for path in files:
        text = tree.text_of(path)
        if text is None:
            continue
        for number, line in enumerate(text.splitlines(), 1):
            if joined.search(line):
                found.append(f"{tree.relative(path)}:{number}: {line.strip()[:120]}")
    return found


def test_nothing_is_marked_as_unfinished():
    words = [rf"\b{word}\b" for word in UNFINISHED]
    assert _hits(words, tree.project_files()) == []


def test_no_path_of_one_machine():
    assert _hits(MACHINE_PATHS, tree.project_files()) == []


def test_no_test_is_expected_to_fail():
    assert _hits(TESTS_LEFT_OUT, [p for p in tree.python_files() if tree.relative(p).startswith("tests/")]) == []


@pytest.mark.parametrize("word", UNFINISHED)
def test_the_marker_rule_finds_a_planted_word(tmp_path, monkeypatch, word):
    planted = tmp_path / "planted.py"
    planted.write_text(f"# {word}: later\n")
    monkeypatch.setattr(tree, "ROOT", tmp_path)
    assert len(_hits([rf"\b{word}\b"], [planted])) == 1


def test_no_lock_or_configuration_names_a_package_host():
    files = [
        p for p in tree.project_files() if p.suffix in (".lock", ".toml") or p.name in ("Makefile", "run", "prepare")
    ]
    assert len(files) >= 4
    assert _hits([r"index-url", r"--find-links", r"https?://(?!json-schema)\S*(pypi|simple|wheel)"], files) == []
