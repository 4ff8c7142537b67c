"""`make test` and `make test-long`: no folder of tests is left out of both, and a campaign gets the seed it was asked for."""

import importlib.util
import os
import subprocess
import sys
from importlib.machinery import SourceFileLoader

import pytest

from tests.rules import tree


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(str(tree.ROOT / "tools"))

    def load(name):
        loader = SourceFileLoader(f"{name}_tool", str(tree.ROOT / "tools" / name))
        module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
        loader.exec_module(module)
        return module

    return load


def test_every_folder_of_tests_belongs_to_a_lane(tool):
    everyday = tool("test_all")
    commands = [lane.command for lane in everyday.lanes()] + [lane.command for lane in tool("test_long").lanes(1)]
    (most,) = (command for command in commands if "tests" in command)
    left_out = {word.removeprefix("--ignore=") for word in most if word.startswith("--ignore=")}
    named = {word for command in commands for word in command if word.startswith("tests/")}
    assert left_out == {f"tests/{name}" for name in everyday.ELSEWHERE} <= named


def test_a_campaign_gets_the_seed_and_paths_of_the_project(tool, monkeypatch):
    long = tool("test_long")
    monkeypatch.setitem(long.CAMPAIGNS, "attack", ("{python}", "tools/attack", "--seed", "{seed}"))
    lane = long.lanes(7)[-1]
    assert (lane.name, lane.command) == ("attack", [sys.executable, f"{tree.ROOT}/tools/attack", "--seed", "7"])


def test_a_lane_that_does_not_exist_is_no_success():
    done = subprocess.run(
        [sys.executable, tree.ROOT / "tools" / "test_long", "no-such-lane"], capture_output=True, text=True
    )
    assert done.returncode == 2 and "no lane no-such-lane" in done.stderr


def test_a_failing_campaign_fails_the_whole(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(tree.ROOT / "tools"))
    import lanes

    monkeypatch.setattr(lanes, "RESULTS", tmp_path)
    before = os.getcwd()
    try:
        failing = lanes.Lane("bad", [sys.executable, "-c", "raise SystemExit(3)"])
        good = lanes.Lane("good", [sys.executable, "-c", ""])
        assert lanes.run_lanes([failing, good], []) == 1
        assert lanes.run_lanes([failing, good], ["good"]) == 0
    finally:
        os.chdir(before)
    assert "FAILED (3)" in capsys.readouterr().out
