"""Files that commands write: refused before any work, never over the log that is read, whole or absent."""

import subprocess
import sys
from pathlib import Path

import pytest

from hilrunner.base import exit_codes
from hilrunner.base.errors import LogError, UsageError
from hilrunner.cli import INTERRUPTED, main
from hilrunner.commands.targets import (
    check_folder,
    check_new_log,
    check_targets,
    claim_free_log,
    claim_log,
    whole,
    write_text,
)
from tests.tools.error_lines import error_lines


def test_an_interrupted_write_leaves_what_was_there(tmp_path):
    target = tmp_path / "run.mcap"
    target.write_text("before")
    with pytest.raises(KeyboardInterrupt), whole(target) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "before" and list(tmp_path.iterdir()) == [target]


def test_a_refusal_names_the_file_the_user_named(tmp_path):
    target = tmp_path / "run.mcap"
    with pytest.raises(LogError, match="run.mcap: disk full") as refused, whole(target) as part:
        raise LogError(str(part), "disk full")
    assert "part" not in str(refused.value) and not list(tmp_path.iterdir())


def test_a_link_stays_a_link_and_its_file_gets_the_text(tmp_path):
    real, link = tmp_path / "real.html", tmp_path / "link.html"
    real.write_text("old")
    link.symlink_to(real)
    write_text(link, "new")
    assert link.is_symlink() and real.read_text() == "new"


def test_the_log_that_is_read_is_no_target(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_text("evidence")
    (tmp_path / "other.mcap").symlink_to(log)
    for name in ("run.mcap", "other.mcap"):
        with pytest.raises(UsageError, match="is the log that is read"):
            check_targets([tmp_path / name], log=log)


@pytest.mark.parametrize("target", ["/proc/none/x.html", "/proc/x.html", "/dev/full/x.html"])
def test_what_cannot_be_written_is_refused_before(target):
    from pathlib import Path

    with pytest.raises(UsageError, match="cannot be written"):
        check_targets([Path(target)])


def test_a_folder_where_a_file_is_meant_and_the_reverse(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a folder"):
        check_targets([tmp_path])
    with pytest.raises(UsageError, match="is not a folder"):
        check_folder(tmp_path / "file")


@pytest.mark.parametrize("option", ["--html", "--junit"])
def test_report_spares_its_log(tmp_path, capsys, option):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"\x89MCAP0\r\nand more")
    assert main(["report", str(log), option, str(log)]) == exit_codes.BAD_INPUT
    assert "is the log that is read" in capsys.readouterr().err
    assert log.read_bytes() == b"\x89MCAP0\r\nand more"


def test_simulate_refuses_targets_before_it_works(tmp_path, capsys):
    for words, told in (
        (["--out", "/proc/x.mcap"], "/proc/x.mcap"),
        (["--plot", "/proc/x.png"], "/proc/x.png"),
        (["--plot", str(tmp_path / "x.pdf")], "is not a format"),
    ):
        assert main(["simulate", *words]) == exit_codes.BAD_INPUT
        assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["simulate", "replay"])
def test_a_log_is_replaced_only_when_told_to(tmp_path, capsys, monkeypatch, command):
    """Also a file that is no log: who knows what it proves."""
    log, target = tmp_path / "run.mcap", tmp_path / "old.mcap"
    log.write_bytes(b"\x89MCAP0\r\n")
    target.write_text("evidence")
    words = [command, *([str(log)] if command == "replay" else []), "--out", str(target)]
    assert main(words) == exit_codes.BAD_INPUT
    told = capsys.readouterr().err
    assert all(word in told for word in (str(target), "exists already (8 bytes)", "another file", "--overwrite")), told
    assert target.read_text() == "evidence"
    check_new_log(target, overwrite=True, log=log)
    with pytest.raises(UsageError, match="is the log that is read"):
        check_new_log(log, overwrite=True, log=log)


def test_no_page_takes_the_place_of_a_log(tmp_path, capsys):
    log, other, page = tmp_path / "run.mcap", tmp_path / "other.mcap", tmp_path / "page.html"
    for path in (log, other):
        path.write_bytes(b"\x89MCAP0\r\nand more")
    page.write_text("<html>")
    for option in ("--html", "--junit"):
        assert main(["report", str(log), option, str(other)]) == exit_codes.BAD_INPUT
        assert "is a log of a run" in capsys.readouterr().err
    check_targets([page], log=log)  # a page can be made again
    assert other.read_bytes() == b"\x89MCAP0\r\nand more"


def test_the_name_of_a_log_is_taken_by_one_run_only(tmp_path):
    path = tmp_path / "new" / "run.mcap"
    assert claim_log(path, overwrite=False) and path.read_bytes() == b""
    with pytest.raises(UsageError, match="exists already"):
        claim_log(path, overwrite=False)
    assert not claim_log(path, overwrite=True)
    for overwrite in (False, True):
        with pytest.raises(LogError, match="is a directory; remedy: choose another --log"):
            claim_log(tmp_path, overwrite=overwrite)
    assert not claim_log(Path("/dev/null"), overwrite=False), (
        "another thing that is no file is the recorder's to refuse"
    )


def test_runs_of_the_same_second_have_logs_of_their_own(tmp_path):
    names = [claim_free_log(tmp_path / "runs", "x").name for _ in range(3)]
    assert names == ["x.mcap", "x-2.mcap", "x-3.mcap"]


def test_a_run_replaces_a_log_only_when_told_to(tmp_path):
    log = tmp_path / "run.mcap"
    words = [
        sys.executable,
        "-m",
        "hilrunner",
        "--stimulus",
        "hold",
        "--duration",
        "0.2",
        "--priority",
        "0",
        "--log",
        log,
    ]
    first = subprocess.run(words, capture_output=True, text=True)
    assert first.returncode != exit_codes.BAD_INPUT, first.stderr
    evidence = log.read_bytes()
    assert evidence[:8] == evidence[-8:] == b"\x89MCAP0\r\n"
    second = subprocess.run(words, capture_output=True, text=True)
    assert second.returncode == exit_codes.BAD_INPUT and log.read_bytes() == evidence
    (told,) = error_lines(second.stderr)
    assert f"{log}: exists already" in told
    third = subprocess.run([*words, "--overwrite"], capture_output=True, text=True)
    assert third.returncode != exit_codes.BAD_INPUT, third.stderr
    assert log.read_bytes() != evidence and log.read_bytes()[-8:] == b"\x89MCAP0\r\n"


def test_simulate_writes_whole_files(tmp_path, capsys):
    log, plot = tmp_path / "new" / "run.mcap", tmp_path / "run.svg"
    words = ["simulate", "--schedule", "steps", "--duration", "0.2", "--out", str(log), "--plot", str(plot)]
    assert main(words) == exit_codes.PASSED
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["run.mcap", "run.svg"]
    assert main(["report", str(log), "--html", str(tmp_path / "pages" / "report.html")]) == exit_codes.PASSED
    capsys.readouterr()


def test_an_interrupt_is_no_verdict(monkeypatch, capsys):
    """Exit code 0 means a passed verdict: an interrupted report must not claim it."""

    def interrupted(_args):
        raise KeyboardInterrupt

    monkeypatch.setattr("hilrunner.commands.report.main", interrupted)
    assert main(["report", "run.mcap"]) == INTERRUPTED
    assert "interrupted" in capsys.readouterr().err
    monkeypatch.setattr("hilrunner.commands.run.main", interrupted)
    assert main(["run"]) == INTERRUPTED, "no tick has run: nothing was passed"
    capsys.readouterr()
