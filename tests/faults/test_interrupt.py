"""Ctrl-C and SIGTERM at any moment of a command: quiet, the documented exit code, nothing half-written.

Both signals have one handler, so each moment is tried with one of them; tests/long tries both at random moments.
"""

import itertools
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilrunner import cli
from hilrunner.base import exit_codes, status
from hilrunner.cli import INTERRUPTED
from hilrunner.commands.compile_progress import PREFIX
from hilrunner.commands.run_verdict import exit_code_of
from hilrunner.evidence.reader import read_run
from hilrunner.setup.arm import local_ring, ring_shape
from hilrunner.setup.profile import load_profile

NUMBERS = [signal.SIGINT, signal.SIGTERM]
TOLD = "hilrunner: interrupted before there was a result; nothing is left half done\n"
STIMULUS = ["--stimulus", "hold", "--duration", "0.2", "--priority", "0"]
# `now()` is a signal to the own process: what a test puts in front of the command decides at which moment it comes
PROGRAM = """
import os, sys

def now():
    os.kill(os.getpid(), {number})

{before}
from hilrunner.cli import main
sys.exit(main())
"""
AT_IMPORT = """
class Moment:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            now()

sys.meta_path.insert(0, Moment())
"""


def signalled(before: str, words: list, folder: Path, number=signal.SIGINT, ignored=False):
    """A command with a moment put in front of it, as a process of its own."""
    program = PROGRAM.format(before=before, number=int(number))
    # told each time: whoever started the tests in the background may have it ignored
    handler = signal.SIG_IGN if ignored else signal.SIG_DFL
    done = subprocess.run(
        [sys.executable, "-c", program, *words], capture_output=True, text=True, cwd=folder, timeout=200,
        preexec_fn=lambda: signal.signal(number, handler),
    )  # fmt: skip
    done.stderr = "".join(
        line for line in done.stderr.splitlines(True) if not line.startswith(PREFIX)
    )  # not compiled yet
    return done


def quiet(done) -> bool:
    return (done.returncode, done.stdout, done.stderr) == (INTERRUPTED, "", TOLD)


@pytest.mark.parametrize(
    ("words", "module", "number"),
    [
        (["run", *STIMULUS], "argparse", signal.SIGTERM),
        (["run", *STIMULUS], "numpy", signal.SIGINT),
        (STIMULUS, "numba", signal.SIGTERM),
        (["report", "run.mcap", "--html", "page.html"], "numba", signal.SIGINT),
        (["check", "amc-lift"], "msgspec", signal.SIGTERM),
    ],
)
def test_while_a_command_is_imported(words, module, number, tmp_path):
    done = signalled(AT_IMPORT.format(module=module), words, tmp_path, number)
    assert quiet(done) and not list(tmp_path.iterdir()), done


@pytest.mark.parametrize(
    ("function", "number"),
    list(zip(["create_ring", "build_axes", "run_files", "arm", "run_loop"], itertools.cycle(NUMBERS), strict=False)),
)
def test_while_a_run_is_built(function, number, tmp_path):
    """The log's name is taken by then, the loop's thread waits, at the end the recorder has opened the log."""
    before = f"""
import hilrunner.setup.session as session
place = session.launch if {function!r} == "create_ring" else session
honest = place.{function}

def late(*words, **options):
    made = honest(*words, **options)
    now()
    return made

place.{function} = late
"""
    done = signalled(before, ["run", *STIMULUS, "--log", "run.mcap"], tmp_path, number)
    assert quiet(done) and not list(tmp_path.iterdir()), done


@pytest.mark.parametrize("number", NUMBERS)
def test_after_the_last_tick_the_log_and_the_verdict_come_all_the_same(number, tmp_path):
    before = """
from hilrunner.setup.session import Session
honest = Session.finish

def finish(session):
    now()
    result = honest(session)
    now()
    return result

Session.finish = finish
"""
    done = signalled(before, ["run", *STIMULUS, "--log", "run.mcap"], tmp_path, number)
    assert done.returncode in (exit_codes.PASSED, exit_codes.VERDICT_FAILED) and not done.stderr, done
    assert f"exit code {done.returncode}" in done.stdout
    run = read_run(tmp_path / "run.mcap")
    assert run.metadata["run"]["exit_reason"] == "duration reached" and not run.damage


TWICE = """
import time
import hilrunner.commands.run_session as command
honest, told = command.Session.running, []

def running(session, timeout_s):
    if not told:
        time.sleep(0.5)
        told.append(now())
        now()
    return honest(session, timeout_s)

command.Session.running = running
"""


@pytest.mark.parametrize("number", NUMBERS)
def test_a_wish_told_twice_is_one_wish(number, tmp_path):
    """Ctrl-C reaches the run from the terminal and once more from a parent that passes it on."""
    done = signalled(
        TWICE,
        ["run", "--stimulus", "hold", "--priority", "0", "--log", "run.mcap"],
        tmp_path,
        number,
    )
    assert done.returncode in (exit_codes.PASSED, exit_codes.VERDICT_FAILED) and not done.stderr, done
    assert read_run(tmp_path / "run.mcap").metadata["run"]["exit_reason"] == "stopped by signal"


@pytest.mark.parametrize(("ticks", "code"), [(0, INTERRUPTED), (1, exit_codes.PASSED)])
def test_a_run_without_a_tick_has_passed_nothing(ticks, code):
    """All was ready, and the signal came before the loop looked at the clock."""
    ring = local_ring(ring_shape(load_profile("amc-lift"), seconds=0.01))
    bench = SimpleNamespace(progress=np.array([(ticks,)], [("tick_count", "i8")]))
    ended = SimpleNamespace(exit_reason=status.EXIT_SIGNAL, armed=SimpleNamespace(bench=bench), ring=ring, recorder={})
    assert exit_code_of(ended, {"exit_code": exit_codes.PASSED}) == code


def test_who_insists_ends_a_run_that_does_not_stop(tmp_path):
    words = ["run", "--stimulus", "hold", "--priority", "0", "--no-log"]
    done = signalled(TWICE + "command._INSIST_S = -1.0", words, tmp_path)
    assert (done.returncode, done.stderr) == (INTERRUPTED, TOLD)


def of_profiles(body: str) -> str:
    """`hilrunner profiles` that does something else."""
    lines = "\n    ".join(body.splitlines())
    return f"import time, weakref\nimport hilrunner.commands.profiles as command\ndef other(_):\n    {lines}\ncommand.main = other\n"


def test_an_interrupt_that_python_drops_comes_again(tmp_path):
    """Raised inside a callback of the interpreter it would be printed as ignored, and the command would go on."""
    body = "class Thing: pass\nthing = Thing()\nkept = weakref.ref(thing, lambda _: now())\ndel thing\ntime.sleep(30)\nprint('went on')"
    assert quiet(done := signalled(of_profiles(body), ["profiles"], tmp_path)), done


def test_what_breaks_because_of_the_interrupt_is_not_told(tmp_path):
    """An extension module makes an ImportError of the interrupt; a half-made object fails in its destructor."""
    body = "class Half:\n    def __del__(self): raise AttributeError('handle')\nhalf = Half()\ntry: now()\nexcept KeyboardInterrupt: raise ImportError('numpy')"
    assert quiet(done := signalled(of_profiles(body), ["profiles"], tmp_path)), done


def test_the_exit_code_is_ours_also_out_of_generated_code(tmp_path):
    """The interpreter remembers an interrupt inside `exec` of a text, and would end by the signal."""
    assert quiet(done := signalled(of_profiles("exec('now()', globals())"), ["profiles"], tmp_path)), done


@pytest.mark.parametrize("number", NUMBERS)
def test_a_result_that_is_out_is_not_taken_back(number, tmp_path):
    done = signalled("import atexit\natexit.register(now)\n", ["--version"], tmp_path, number)
    assert (done.returncode, done.stderr) == (0, "")


def test_in_the_background_of_a_script_only_a_run_listens(tmp_path):
    moment = AT_IMPORT.format(module="msgspec")
    assert signalled(moment, ["profiles"], tmp_path, ignored=True).returncode == exit_codes.PASSED
    assert quiet(signalled(moment, ["run", *STIMULUS], tmp_path, ignored=True))


def test_a_caller_gets_its_own_handlers_back(capsys):
    before = [signal.getsignal(number) for number in NUMBERS], sys.unraisablehook
    assert cli.main(["--version"]) == 0
    assert ([signal.getsignal(number) for number in NUMBERS], sys.unraisablehook) == before
    capsys.readouterr()
