"""`hilrunner run` with bad input: one clear line on stderr that names place, value, limit or remedy, the documented exit code, nothing written."""

import gc
import os
import socket

import pytest

from hilrunner.base import exit_codes
from hilrunner.cli import main
from tests.tools.error_lines import error_lines

SCHEDULE = ["--stimulus", "hold", "--duration", "1"]

BAD = {
    "missing interface": (["--can", "can99"], exit_codes.CAN_LOST, ["can99", "no such network interface", "vcan"]),
    "no bus, no stimulus": ([], exit_codes.BAD_INPUT, ["no bus and no stimulus", "--stimulus"]),
    "two channels": (["--can", "a0", "-c", "b0"], exit_codes.BAD_INPUT, ["a0", "b0"]),
    "unknown profile": (
        ["--profile", "amc-lif", *SCHEDULE],
        exit_codes.BAD_INPUT,
        ["amc-lif", "did you mean 'amc-lift'"],
    ),
    "less than a period": (
        ["--stimulus", "hold", "--duration", "1e-9"],
        exit_codes.BAD_INPUT,
        ["--duration", "1e-09 s", "shorter than one period", "at least 0.001 s"],
    ),
    "less than the period asked for": (
        ["--stimulus", "hold", "--duration", "0.001", "--period-us", "2000"],
        exit_codes.BAD_INPUT,
        ["--duration", "at least 0.002 s"],
    ),
    "a stimulus without a name": (
        ["-i", "virtual", "-c", "x", "--stimulus", ""],
        exit_codes.BAD_INPUT,
        ["its name is empty"],
    ),
    "no such schedule": (["--stimulus", "none.csv"], exit_codes.BAD_INPUT, ["none.csv", "lift-profile"]),
    "unwritable log": (
        [*SCHEDULE, "--log", "/proc/none/x.mcap"],
        exit_codes.BAD_INPUT,
        ["/proc/none/x.mcap", "cannot be created", "--log"],
    ),
    "log is a folder": ([*SCHEDULE, "--log", "."], exit_codes.BAD_INPUT, ["--log", "directory"]),
    "unknown backend": (["-i", "no-such", "-c", "x"], exit_codes.BAD_INPUT, ["no-such"]),
}


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not list(tmp_path.rglob("*.mcap")), "nothing may be half-written"


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, capsys):
    words, code, told = BAD[name]
    assert main(["run", *words]) == code
    (text,) = error_lines(capsys.readouterr().err)
    assert text.startswith("hilrunner run:") and "Traceback" not in text, text
    for word in told:
        assert word in text, text


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ('model = "none.onnx"', ["none.onnx"]),
        ('circuit = "paper"\npreset = "paper"\nmodel = "lift-flow.onnx"', ["lift-flow.onnx", "paper"]),
        ('model = "lift-flow.onnx"\n[axis.parameters]\nmass_tonnes = 3.0', ["mass_tonnes"]),
        ('model = "lift-flow.onnx"\n[axis.parameters]\nmass_kg = -3.0', ["mass_kg", "-3"]),
        ('model = "lift-flow.onnx"\nreference_substeps = 2', ["reference_substeps", "unstable"]),
        ('model = "lift-flow.onnx"\n[can]\ndbc = "none.dbc"', ["none.dbc"]),
    ],
)
def test_a_profile_that_cannot_be_built(in_an_empty_folder, capsys, change, told):
    profile = in_an_empty_folder / "mine.toml"
    profile.write_text(f'name = "mine"\n[[axis]]\nname = "luffing"\n{change}\n')
    assert main(["run", "--profile", str(profile), *SCHEDULE, "--no-log"]) == exit_codes.BAD_INPUT
    (text,) = error_lines(capsys.readouterr().err)
    for word in told:
        assert word in text, text
    assert gc.isenabled(), "rights are given back by a start that failed"


def test_a_foreign_command_word(capsys):
    assert main(["frobnicate"]) == exit_codes.BAD_INPUT
    assert "frobnicate" in capsys.readouterr().err


def test_the_overview_names_every_command(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    for word in ("--can vcan0", "simulate", "replay", "exit codes"):
        assert word in out


SECONDS = "allowed: above 0 to 1e+07 s"
OUT_OF_RANGE = [
    ("run --duration inf", SECONDS),
    ("run --duration nan", SECONDS),
    ("run --duration 0", SECONDS),
    ("run --spin-us -5", "allowed: 0 to 10000 us"),
    ("run --cpu -5", "no core -5; allowed: 0"),
    ("run --cpu 99999", "no core 99999; allowed: 0"),
    ("run -b -5", "allowed: 10000 to 8000000 bit/s"),
    ("run --period-us 3", "3 us; allowed: 50 to 1000000 us"),
    ("run --period-us 1e3", "a whole number"),
    ("run --priority 120", "allowed: 0 to 99"),
    ("run --live 99999999", "allowed: 0 to 65535"),
    ("simulate --duration nan", SECONDS),
    ("simulate --duration -1", SECONDS),
    ("replay run.mcap --duration inf", SECONDS),
    ("doctor --seconds nan", SECONDS),
    ("doctor --cpu 99999", "no core 99999"),
    ("train --seconds soon", "a number of seconds"),
    ("bench --rounds 0", "allowed: 1 to 1000"),
    ("bench --slice-s nan", "nan s; allowed: 0.02 to 1e+07 s"),
    ("bench --slice-s -1", "allowed: 0.02"),
    ("bench --slice-s 0", "allowed: 0.02"),
    ("bench --log-s nan", "allowed: 0.02"),
    ("bench --cpu 99999", "no core 99999"),
    ("bench --priority 100", "allowed: 0 to 99"),
    ("bench --spin-us -1", "allowed: 0 to 10000 us"),
]


@pytest.mark.parametrize(("line", "told"), OUT_OF_RANGE)
def test_a_number_out_of_range(line, told, capsys, monkeypatch):
    words = line.split()
    monkeypatch.setattr(f"hilrunner.commands.{words[0]}.main", lambda _: pytest.fail("the command went to work"))
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == exit_codes.BAD_INPUT
    (only,) = capsys.readouterr().err.splitlines()
    for word in (words[-2], words[-1], told, "remedy:"):
        assert word in only, only


def test_a_duration_without_a_period_is_refused_before_anything_is_built(monkeypatch, capsys):
    monkeypatch.setattr("hilrunner.commands.run_session.Session", lambda *_: pytest.fail("a session was made"))
    monkeypatch.setattr("hilrunner.setup.simulate.simulate", lambda *_: pytest.fail("a plant was built"))
    for command in (["run", "--stimulus", "hold"], ["simulate"]):
        assert main([*command, "--duration", "0.0009"]) == exit_codes.BAD_INPUT
        assert "shorter than one period" in capsys.readouterr().err


@pytest.mark.parametrize("listens", [True, False])
def test_a_live_port_is_looked_at_before_anything_is_loaded(listens, monkeypatch, capsys):
    reached = []
    monkeypatch.setattr("hilrunner.commands.run_session.execute", lambda *_: reached.append(1) or 0)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        if listens:
            other.listen()
        else:
            other.close()
        code = main(["run", *SCHEDULE, "--no-log", "--live", str(port)])
    assert (code, reached) == ((exit_codes.BAD_INPUT, []) if listens else (exit_codes.PASSED, [1]))
    text = capsys.readouterr().err
    assert not listens or all(word in text for word in (f"--live {port}", "in use", "another port")), text


def test_no_core_is_asked_for_by_minus_one_and_each_core_there_is_may_be_named():
    from hilrunner.commands import options

    assert options.core("-1") == -1
    assert [options.core(str(core)) for core in sorted(os.sched_getaffinity(0))] == sorted(os.sched_getaffinity(0))


def profile_without_model(folder):
    profile = folder / "mine.toml"
    profile.write_text('name = "mine"\n[[axis]]\nname = "luffing"\nmodel = "none.onnx"\n')
    return profile


def test_a_refused_start_leaves_a_file_of_somebody_else_alone(in_an_empty_folder, capsys):
    """A run replaces a log only when told to, and only when it starts."""
    theirs = in_an_empty_folder / "evidence.txt"
    theirs.write_text("kept")
    words = ["run", "--profile", str(profile_without_model(in_an_empty_folder)), *SCHEDULE, "--log", str(theirs)]
    assert main(words) == exit_codes.BAD_INPUT
    assert "exists already (4 bytes)" in capsys.readouterr().err and theirs.read_text() == "kept"
    assert main([*words, "--overwrite"]) == exit_codes.BAD_INPUT
    assert "none.onnx" in capsys.readouterr().err and theirs.read_text() == "kept"


def test_a_refused_start_takes_its_own_empty_log_with_it(in_an_empty_folder, capsys):
    words = ["run", "--profile", str(profile_without_model(in_an_empty_folder)), *SCHEDULE]
    for log in (["--log", "new.mcap"], []):
        assert main([*words, *log]) == exit_codes.BAD_INPUT
    assert main(["run", "--can", "can99", "--log", "new.mcap"]) == exit_codes.CAN_LOST
    capsys.readouterr()
    assert not list(in_an_empty_folder.rglob("*.mcap"))
