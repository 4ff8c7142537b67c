"""Standard output that cannot be written: no command shows a traceback, and none claims a verdict that nobody could read."""

import os
import subprocess
import sys

import pytest

from hilrunner.base import exit_codes
from hilrunner.commands import streams
from hilrunner.evidence.reader import read_run


@pytest.fixture
def gone():
    """The writing end of a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


def hilrunner(*words, unbuffered="", **streams_):
    command = [sys.executable, "-m", "hilrunner", *map(str, words)]
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams_
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    return subprocess.run(command, text=True, check=False, env=environment, **settings)


@pytest.mark.parametrize("words", [["--help"], ["report", "--help"], ["profiles"], ["profiles", "--json"]])
def test_a_reader_that_has_gone_ends_a_command_quietly(gone, words):
    done = hilrunner(*words, stdout=gone)
    assert (done.returncode, done.stderr) == (streams.PIPE_CLOSED, "")


def test_the_same_where_every_word_is_written_at_once(gone):
    done = hilrunner("profiles", stdout=gone, unbuffered="1")
    assert (done.returncode, done.stderr) == (streams.PIPE_CLOSED, "")


def test_nobody_reads_the_errors_either(gone):
    assert hilrunner("frobnicate", stdout=gone, stderr=gone).returncode == streams.PIPE_CLOSED


def test_a_full_disk_under_the_output_is_told(tmp_path):
    with open("/dev/full", "w") as full:
        done = hilrunner("profiles", stdout=full)
    assert done.returncode == exit_codes.BAD_INPUT
    assert done.stderr == "hilrunner: the output cannot be written: No space left on device\n"


def test_a_run_outlives_the_reader_of_its_output(gone, tmp_path):
    """`hilrunner run ... | head` must not end the run, cut its log or pass for a verdict."""
    log = tmp_path / "run.mcap"
    words = ["--stimulus", "hold", "--duration", "0.5", "--priority", "0", "--log", log]
    done = hilrunner("run", *words, stdout=gone)
    assert "Traceback" not in done.stderr and done.returncode != streams.PIPE_CLOSED
    run = read_run(log)
    assert run.metadata["run"]["exit_reason"] == "duration reached"
    # a skipped period has a row of its own, or the row after it tells of it
    assert len(run.tick) + int(run.tick["skipped_count"].sum()) == 500 and not run.damage


def test_an_error_that_is_not_about_the_output_stays_one(tmp_path):
    with pytest.raises(FileNotFoundError), streams.spare_the_work():
        (tmp_path / "none").read_text()
