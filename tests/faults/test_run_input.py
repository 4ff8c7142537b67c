"""`hilrunner run` with bad input: one clear line on stderr that names place, value, limit or remedy, the documented exit code, nothing written."""

import gc

import pytest

from hilrunner.base import exit_codes
from hilrunner.cli import main

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
    "impossible period": (["--period-us", "3", *SCHEDULE], exit_codes.BAD_INPUT, ["--period-us", "3 us", "50 to"]),
    "priority": (["--priority", "120", *SCHEDULE], exit_codes.BAD_INPUT, ["--priority", "120", "99"]),
    "no such schedule": (["--stimulus", "none.csv"], exit_codes.BAD_INPUT, ["none.csv", "lift-profile"]),
    "unwritable log": ([*SCHEDULE, "--log", "/proc/none/x.mcap"], exit_codes.BAD_INPUT, ["/proc/none", "--log"]),
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
    text = capsys.readouterr().err.strip()
    assert text.startswith("hilrunner run:") and "Traceback" not in text and len(text.splitlines()) == 1, text
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
    text = capsys.readouterr().err.strip().splitlines()[-1]
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


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--duration", "inf"],
        ["run", "--duration", "nan"],
        ["run", "--duration", "0"],
        ["run", "--spin-us", "-5"],
        ["run", "--cpu", "-5"],
        ["run", "-b", "-5"],
        ["simulate", "--duration", "nan"],
        ["simulate", "--duration", "-1"],
        ["replay", "run.mcap", "--duration", "inf"],
        ["doctor", "--seconds", "nan"],
        ["train", "--seconds", "soon"],
    ],
)
def test_a_number_out_of_range(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == exit_codes.BAD_INPUT
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert words[-2] in last and words[-1] in last, last


def test_a_refused_start_leaves_a_file_of_somebody_else_alone(in_an_empty_folder, capsys):
    """The log cannot be opened, so the file under its name is not the run's to delete."""
    theirs = in_an_empty_folder / "evidence.txt"
    theirs.write_text("kept")
    assert main(["run", *SCHEDULE, "--log", str(theirs), "--live", "99999999"]) == exit_codes.BAD_INPUT
    assert "--live" in capsys.readouterr().err and theirs.read_text() == "kept"
