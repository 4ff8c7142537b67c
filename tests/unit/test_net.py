"""What nobody foresaw ends in one line with place and remedy; streams that are closed or know few letters end nothing."""

import io
import os
import subprocess
import sys

import pytest

from hilrunner import cli
from hilrunner.base import exit_codes
from hilrunner.commands import net, profiles, streams


def from_a_library():
    import json

    json.loads("{")


def from_ours():
    from hilrunner.base.ring import view

    view(None, None)


def from_the_system():
    raise OSError(28, "No space left on device", "/somewhere/run.mcap")


def nested():
    nested()


@pytest.mark.parametrize(
    ("fails", "told"),
    [
        (from_a_library, ["JSONDecodeError", "decoder.py"]),
        (from_ours, ["hilrunner/base/ring.py line", "in _parts"]),
        (from_the_system, ["the system refused: /somewhere/run.mcap: No space left on device"]),
        (nested, ["nested too deeply"]),
    ],
)
def test_one_line_with_place_and_remedy(monkeypatch, capsys, fails, told):
    monkeypatch.delenv(net.TRACEBACK_VARIABLE, raising=False)
    monkeypatch.setattr(profiles, "main", lambda _: fails())
    assert cli.main(["profiles"]) == exit_codes.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hilrunner profiles: ") and "remedy: run it again with HILRUNNER_TRACEBACK=1" in line
    for word in told:
        assert word in line, line


def test_a_package_that_is_missing_is_named(monkeypatch, capsys):
    monkeypatch.setattr(profiles, "main", lambda _: __import__("no_such_package.inner"))
    assert cli.main(["profiles"]) == exit_codes.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "the package no_such_package is not installed" in line and "remedy: " in line


def test_the_whole_trace_is_shown_when_asked_for(monkeypatch, capsys):
    monkeypatch.setenv(net.TRACEBACK_VARIABLE, "1")
    monkeypatch.setattr(profiles, "main", lambda _: from_a_library())
    assert cli.main(["profiles"]) == exit_codes.BAD_INPUT
    told = capsys.readouterr().err
    assert told.startswith("Traceback (most recent call last)") and "remedy" in told.splitlines()[-1]


def test_a_message_of_several_lines_becomes_one(monkeypatch, capsys):
    def fails(_):
        raise RuntimeError("first\nsecond\x1b[31m")

    monkeypatch.setattr(profiles, "main", fails)
    cli.main(["profiles"])
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_stream_that_is_not_there_is_no_terminal():
    closed = io.StringIO()
    closed.close()
    assert not any(streams.is_terminal(one) for one in (None, closed, io.StringIO()))


@pytest.mark.parametrize("closed", ["1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_streams_end_nothing(closed):
    """The result is told by the exit code alone; nothing of ours is opened under the number of a stream."""
    words = f'"{sys.executable}" -P -m hilrunner profiles {closed}'
    assert subprocess.run(["sh", "-c", words], check=False, cwd="/", env=os.environ).returncode == 0


SHADOWS = ("signal", "can", "json", "numpy", "random", "select", "platform", "token", "mcap", "zstandard", "msgspec")


@pytest.mark.parametrize("module", ["hilrunner", "hilrunner.record"])
def test_files_in_the_working_folder_are_not_imported(tmp_path, module):
    """`python -m` looks into the working folder first; an empty entry of PYTHONPATH means the same."""
    from hilrunner.record import child

    for name in SHADOWS:
        (tmp_path / f"{name}.py").write_text(f'raise SystemExit("{name}.py of the working folder was imported")\n')
    command = child.module_command(module)
    environment = child.environment() | {"NUMBA_DISABLE_JIT": "1"}
    if module == "hilrunner":
        command = [sys.executable, "-m", "hilrunner", "profiles"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_environment_of_a_process_of_ours_names_no_empty_folder(monkeypatch):
    from hilrunner.record import child

    monkeypatch.setenv("PYTHONPATH", ":/one::/two:")
    entries = child.environment(EXTRA="1")["PYTHONPATH"].split(":")
    assert entries[-2:] == ["/one", "/two"] and "" not in entries and "-P" in child.module_command("x")


@pytest.mark.parametrize(
    ("filename", "ours", "shown"),
    [
        ("/home/me/hilrunner/hilrunner/setup/bus.py", True, "hilrunner/setup/bus.py"),
        ("/home/me/hilrunner/.venv/lib/python3.11/site-packages/can/bus.py", False, "can/bus.py"),
        ("/opt/x/lib/python3.11/site-packages/hilrunner/cli.py", True, "hilrunner/cli.py"),
        ("/usr/lib/python3.11/json/decoder.py", False, "decoder.py"),
    ],
)
def test_places_are_told_without_the_folders_of_a_machine(filename, ours, shown):
    assert (net._is_ours(filename), net._short(filename)) == (ours, shown)
