"""No allocation in the period: the runtime's allocation count of the real loop does not depend on the number of ticks."""

import json
import os
import subprocess
import sys

import pytest

from tests.rules import tree


@pytest.mark.parametrize("engine", ["surrogate", "onnx", "reference"])
def test_the_loop_allocates_nothing_per_tick(engine):
    done = subprocess.run(
        [sys.executable, tree.ROOT / "tests" / "rules" / "allocation_scenario.py", engine],
        env={**os.environ, "NUMBA_NRT_STATS": "1", "PYTHONPATH": str(tree.ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["ticks"] == 800 and found["ticks on time"] >= 600
    assert found["frames"] == 48
    assert found["400"] == found["200"]
    assert found["on time 400"] == found["on time 200"]
    assert found["rehearsal_ns"] > 0
    assert found["planted 20"] - found["planted 10"] == 10, "the counter would not see an allocation"
