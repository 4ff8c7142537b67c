"""The codec gives the same verdicts and bytes interpreted as compiled: golden frames and bad frames once more, no JIT."""

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
OPTIONS = "addopts=--strict-markers --import-mode=importlib"  # without -q: the count is wanted
CODEC_TESTS = ("golden/test_golden_frames.py", "faults/test_frames.py", "unit/test_signals.py")


def test_codec_tests_pass_interpreted():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONWARNINGS": "error::RuntimeWarning"}
    files = [str(TESTS / name) for name in CODEC_TESTS]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-o", OPTIONS, *files],
        env=environment, cwd=TESTS.parent, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    assert " passed" in done.stdout and "skipped" not in done.stdout
