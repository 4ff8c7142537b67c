"""A cold start talks: at once where everything is to be compiled, then with what and how far; quiet where all is ready."""

import io
import os
import subprocess
import sys
import time

import pytest

from hilrunner.base import compile_watch, compiled
from hilrunner.commands import compile_progress
from hilrunner.commands.compile_progress import PREFIX, CompileProgress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def soon(monkeypatch):
    """The same rules, a hundred times faster."""
    for name in ("QUIET_S", "LINE_INTERVAL_S", "REWRITE_INTERVAL_S"):
        monkeypatch.setattr(compile_progress, name, getattr(compile_progress, name) / 100)


def until(stream, word):
    deadline_s = time.monotonic() + 60
    while word not in stream.getvalue():
        assert time.monotonic() < deadline_s, stream.getvalue()
        time.sleep(0.005)


def test_plain_lines_say_what_and_how_far_and_go_on_while_one_function_takes_long(soon, monkeypatch, tmp_path):
    stream = io.StringIO()
    monkeypatch.setattr(compile_progress, "defined_names", {str(number) for number in range(150)})
    with CompileProgress(stream) as progress:
        progress.announce(tmp_path / "realtime-0123")
        assert stream.getvalue().startswith(PREFIX) and str(tmp_path) in stream.getvalue()
        progress.note("plant.spool.flow", True)
        progress.note("plant.spool.flow", False)
        progress.note("realtime.loop._run", True)
        until(stream, "1 of about 150 functions")
        before = stream.getvalue().count("now realtime.loop._run")
        while stream.getvalue().count("now realtime.loop._run") < before + 3:
            time.sleep(0.005)
        progress.note("realtime.loop._run", False)
    lines = stream.getvalue().splitlines()
    assert all(line.startswith(PREFIX) and "\r" not in line for line in lines)
    assert lines[-1].startswith(f"{PREFIX}: done, 2 functions in ")


def test_what_takes_less_than_a_second_is_not_told():
    for stream in (io.StringIO(), Terminal()):
        with CompileProgress(stream) as progress:
            progress.note("plant.spool.flow", True)
            progress.note("plant.spool.flow", False)
        assert stream.getvalue() == ""


def test_on_a_terminal_one_line_is_rewritten_and_taken_away(soon):
    stream = Terminal()
    with CompileProgress(stream) as progress:
        progress.note("plant.spool.flow", True)
        until(stream, "now plant.spool.flow")
        progress.note("plant.spool.flow", False)
    shown = stream.getvalue()
    assert "\n" not in shown
    assert shown.endswith("\r" + " " * compile_progress.COLUMNS + "\r")


def test_nothing_is_told_while_nothing_is_compiled(soon):
    """Not in the run that follows: its live line has the terminal then."""
    stream = Terminal()
    with CompileProgress(stream) as progress:
        progress.note("plant.spool.flow", True)
        until(stream, "now plant.spool.flow")
        progress.note("plant.spool.flow", False)
        until(stream, " " * compile_progress.COLUMNS + "\r")
        before = stream.getvalue()
        time.sleep(0.1)
        assert stream.getvalue() == before


def test_a_stream_that_refuses_ends_nothing(soon):
    class Full(io.StringIO):
        def write(self, _text):
            raise OSError(28, "No space left on device")

    with CompileProgress(Full()) as progress:
        progress.announce(compile_progress.Path("cache"))
        progress.note("plant.spool.flow", True)
        time.sleep(0.05)


def test_a_compiled_function_of_ours_is_told_and_others_are_not(monkeypatch):
    told = []
    monkeypatch.setattr(compile_watch, "observers", compile_watch.observers)
    compile_watch.observers.append(lambda *words: told.append(words))

    def inner(x):
        return x + 1

    inner.__module__ = "hilrunner.plant.tiny"
    ours = compiled.hot(inner)

    def outer(x):
        return ours(x)

    outer.__module__ = "somebody.else"
    try:
        assert compiled.hot(outer)(1) == 2
    finally:
        compile_watch.observers.pop()
        compile_watch.defined_names -= {"plant.tiny.inner", "somebody.else.outer"}
    assert told == [("plant.tiny.inner", True), ("plant.tiny.inner", False)]


def test_the_first_words_come_before_anything_heavy_is_imported(tmp_path):
    """With an empty cache, by an interpreter that has no numba at all."""
    program = (
        "import sys; sys.modules['numba'] = None; from hilrunner.cli import main; sys.exit(main(['check', 'amc-lift']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env=os.environ | {"HILRUNNER_CACHE": str(tmp_path)},
    )
    assert done.stderr.splitlines()[0].startswith(f"{PREFIX} the bench, once")
    assert str(tmp_path) in done.stderr.splitlines()[0]
