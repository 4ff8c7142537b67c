"""Every function that runs inside a period also runs interpreted, and gives the compiled numbers: what a debugger shows is what runs."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from tests.rules import tree

ROOMS = ("hilrunner/plant/", "hilrunner/realtime/", "hilrunner/record/")
_RECIPE = "only a network of a recipe that no shipped profile uses gets here; tests of the surrogate train small ones"
# what this scenario does not enter, and why
NOT_ENTERED = {
    "hilrunner.plant.ida_calls:drive": "calls the SUNDIALS library through bare addresses, outside any period",
    "hilrunner.realtime.cycles:_counter": "one instruction of the processor; interpreted runs read the clock instead",
    "hilrunner.plant.surrogate:_advance_article": _RECIPE,
    "hilrunner.plant.surrogate:_article_rates": _RECIPE,
    "hilrunner.plant.surrogate:_modulating_rates": _RECIPE,
    "hilrunner.plant.surrogate:plain_flow_inputs": _RECIPE,
}
RELATIVE = 1e-9  # two libraries' exp and sqrt differ in the last bit, a stiff valve multiplies that


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The scenario compiled, then interpreted."""
    folder = tmp_path_factory.mktemp("scenario")
    for disabled in ("0", "1"):
        done = subprocess.run(
            [sys.executable, tree.ROOT / "tests" / "rules" / "interpreted_scenario.py", folder],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(tree.ROOT)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-4000:]
    return folder


def test_interpreted_and_compiled_agree_in_every_hot_function(runs):
    """One test, because tests of one file may run in several processes and the runs take a minute."""
    assert_equal(runs)
    assert_every_hot_function_was_entered(runs)


def assert_equal(runs):
    with np.load(runs / "compiled.npz") as compiled, np.load(runs / "interpreted.npz") as interpreted:
        assert len(compiled.files) > 50
        assert compiled.files == interpreted.files
        for name in compiled.files:
            if compiled[name].dtype.kind == "f":
                np.testing.assert_allclose(interpreted[name], compiled[name], RELATIVE, 1e-12, err_msg=name)
            else:
                np.testing.assert_array_equal(interpreted[name], compiled[name], err_msg=name)


def assert_every_hot_function_was_entered(runs):
    entered = set(json.loads((runs / "entered.json").read_text()))
    hot = {f"{f.path[:-3].replace('/', '.')}:{f.name}" for f in tree.hot_functions() if f.path.startswith(ROOMS)}
    assert len(hot) > 100
    left_out = sorted(hot - entered - set(NOT_ENTERED))
    assert not left_out, f"extend interpreted_scenario.py: {left_out}"
    assert set(NOT_ENTERED) <= hot, "no longer there: remove the exception"
