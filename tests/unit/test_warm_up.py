"""`hilrunner warm-up` compiles all that a run, its report and its replay need: after it none of them compiles anything."""

import subprocess
import sys

import pytest

from hilrunner.base.compiled_cache import cache_folder

ROOMS = ("plant", "realtime", "record", "setup", "evidence")


def kept() -> set:
    """Compiled functions on disk, of the runner and of its recorder."""
    return {path for room in ROOMS for path in cache_folder(room).glob("*/*.nbc")}


def hilrunner(folder, *words):
    done = subprocess.run([sys.executable, "-m", "hilrunner", *words], capture_output=True, text=True, cwd=folder)
    assert "Traceback" not in done.stderr and done.returncode in (0, 1), done
    return done.stdout


@pytest.mark.timeout(1800)  # it may be the first that compiles, on a busy machine
def test_after_it_nothing_is_compiled(tmp_path):
    assert "warm after" in hilrunner(tmp_path, "warm-up", "amc-lift")
    before = kept()
    assert before and not list(tmp_path.iterdir())
    hilrunner(tmp_path, "run", "--stimulus", "hold", "--duration", "0.3", "--priority", "0", "--log", "run.mcap")
    hilrunner(tmp_path, "report", "run.mcap")
    hilrunner(tmp_path, "replay", "run.mcap")
    assert kept() == before
