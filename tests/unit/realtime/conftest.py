"""The scenarios of the loop on a simulated clock, run once for all tests that judge them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


def _printed(script: str) -> dict:
    """What a script of this folder prints, uncompiled."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name(script))],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="session")
def happened() -> dict:
    return _printed("loop_scenarios.py")


@pytest.fixture(scope="session")
def failed() -> dict:
    return _printed("system_call_scenarios.py")
