"""docs/verdict.md promises what run, report, replay, JUnit, page and exit code say for every way a run can end: each row is tried."""

import html
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilrunner import cli
from hilrunner.base import exit_codes, status
from hilrunner.base.errors import HilrunnerError
from hilrunner.commands.run_verdict import exit_code_of, verdict_of_run
from hilrunner.evidence import replay
from hilrunner.evidence.facts import read_facts
from hilrunner.evidence.judging import verdict_of
from hilrunner.evidence.reader import read_run
from hilrunner.record.mcap_log import LogWriter
from hilrunner.setup.profile import parse_profile
from tests.rules import tree
from tests.tools import synthetic_run

DOCUMENT = tree.ROOT / "docs" / "verdict.md"
TICKS = 600
KEPT = "rod_speed_mmps_max = 1000.0"
BROKEN = "rod_speed_mmps_max = 1.0"
PROFILE = 'name = "judged"\n[[axis]]\nname = "lift"\n[limits]\n'


def rows() -> list[dict[str, str]]:
    """The table under "Every way a run can end", a dictionary a row."""
    part = DOCUMENT.read_text().split("## Every way a run can end")[1]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def log(limits: str = KEPT, edit=None, run=None, **tables):
    """A maker of a log with these limits, altered records, entries of the closing table `run` and of further tables."""

    def make(path: Path) -> None:
        metadata = {"run": run or {}, **tables}
        synthetic_run.write_run(
            path, TICKS, profile_text=PROFILE + limits, edit=edit, metadata=metadata, stall_every=250
        )

    return make


def ended(reason: int):
    return log(run={"exit_reason": status.EXIT_NAMES[reason]})


def without_end(path: Path) -> None:
    """As a recorder leaves it that is killed: whole chunks, no closing metadata, no end."""
    close = LogWriter.close
    LogWriter.close = lambda writer, metadata=None: writer.flush()
    try:
        log()(path)
    finally:
        LogWriter.close = close


def no_profile(path: Path) -> None:
    attached = LogWriter.add_attachment
    LogWriter.add_attachment = lambda writer, name, *rest: attached(writer, name.replace("profile", "other"), *rest)
    try:
        log()(path)
    finally:
        LogWriter.add_attachment = attached


def flipped(path: Path) -> None:
    """Limit 1.0 becomes 9.0 by one bit."""
    log(BROKEN)(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"rod_speed_mmps_max = 1.0") + 21] ^= 8
    path.write_bytes(data)


def out_of_tolerance(block) -> None:
    block["check"]["flags"][300:307] = 1


def silent(block) -> None:
    block["command"]["age_ns"] = -1
    block["command"]["mode"] = status.MODE_WAITING
    block["can"]["status"] = status.FRAME_BAD_CRC


def shortened(block) -> None:
    """The last fifth of the run is not in the log."""
    last = int(block["tick"]["tick"][-1]) * 4 // 5
    for name, array in block.items():
        block[name] = array[array["tick"] <= last]


def fewer_frames(block) -> None:
    block["can"] = block["can"][::2]


STALLED = {"stall_count": "2", "stall_ns_max": "250000000", "stall_first_tick": "300"}
TOLD_ONLY = '\n[deadline.stall_ms]\naction = "warn"\n'
ALLOWED = "ticks_lost_max = 200\nframes_lost_max = 1000\nmisses_lost_max = 5\nunchecked_ticks_max = 200\n"
MAKERS = {
    "as planned, limits kept": log(),
    "as planned, no limits set": log(""),
    "as planned, a limit broken": log(BROKEN),
    "as planned, a limit that cannot be judged": log("tracking_error_mm_max = 10.0"),
    "as planned, out of the cross-check's tolerance": log(edit=out_of_tolerance),
    "out of tolerance, and a limit broken": log(BROKEN, edit=out_of_tolerance),
    "cross-check left ticks out": log(check={"lift.checked_ticks": "100", "left_out_ticks": "400", "error": ""}),
    "no valid command of a firmware": log(edit=silent),
    "deadline budget exceeded": ended(status.EXIT_DEADLINE),
    "CAN lost": ended(status.EXIT_CAN_LOST),
    "the host stalled longer than the profile allows": log(run=STALLED),
    "the host stalled, and the run is out of tolerance": log(edit=out_of_tolerance, run=STALLED),
    "the host stalled, which the profile only tells": log(KEPT + TOLD_ONLY, run=STALLED),
    'ended at once by a stall (`action = "stop"`)': log(
        run=STALLED | {"exit_reason": status.EXIT_NAMES[status.EXIT_STALLED]}
    ),
    "a system call of the loop failed": ended(status.EXIT_SYSTEM_CALL),
    "state not finite": ended(status.EXIT_NOT_FINITE),
    "runner killed, log finished by the recorder": ended(status.EXIT_KILLED),
    "recorder killed, log without an end": without_end,
    "ring full, ticks dropped at the end": log(run={"dropped_ticks": "4412"}),
    "ring full, frames dropped": log(edit=fewer_frames),
    "disk full, ticks lost as the profile allows": log(ALLOWED + KEPT, edit=shortened, run={"lost_messages": "900"}),
    "profile missing in the log": no_profile,
    "profile unreadable in the log": log("rod_speed_mmps_max = = 1.0"),
    "log damaged by one bit": flipped,
}


@pytest.mark.parametrize("row", rows(), ids=lambda row: row["how it ended"])
def test_every_place_says_what_the_table_says(row, tmp_path, capsys):
    path, junit, page = (tmp_path / name for name in ("run.mcap", "junit.xml", "page.html"))
    MAKERS[row["how it ended"]](path)
    code = cli.main(["report", str(path), "--junit", str(junit), "--html", str(page)])
    text = capsys.readouterr().out
    assert str(code) == row["report"]
    verdict = judged(path)
    assert (verdict.outcome, verdict.exit_code) == (row["outcome"], code)
    failing = [key.strip("`") for key in row["row that fails"].split(", ") if key]
    assert sorted(one.key for one in verdict.failed) == sorted(failing)
    assert re.search(rf"^verdict: {row['outcome']}", text, re.MULTILINE | re.IGNORECASE)
    assert all(re.search(rf"^  {key} +(failed|not judged)", text, re.MULTILINE) for key in failing)
    assert junit_words(junit) == row["JUnit"]
    assert html.escape(row["page"]) in page.read_text()
    assert replay_code(path) == int(row["replay"])
    if row["run"] != "-":
        assert run_code(path, verdict) == int(row["run"])


def test_every_row_can_be_made():
    assert {row["how it ended"] for row in rows()} == set(MAKERS)


def judged(path):
    run = read_run(path)
    return verdict_of(run, read_facts(run))[0]


def junit_words(path: Path) -> str:
    suite = ElementTree.parse(path).find("testsuite")
    cases = list(suite.iter("testcase"))
    assert int(suite.get("tests")) == len(cases)
    words = []
    for name, tag in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
        count = sum(case.find(name) is not None for case in cases)
        assert int(suite.get(tag)) == count
        if count:
            words.append(f"{count} {name if count == 1 or name == 'skipped' else name + 's'}")
    return ", ".join(words) or "no failure"


def replay_code(path: Path) -> int:
    """The replay judges the run by itself as everybody does; what it refuses, it refuses with its code."""
    try:
        replay.build_replay(path, replay.ReplayOptions(part="nothing"))
    except HilrunnerError as error:
        return error.exit_code
    return judged(path).exit_code


def run_code(path: Path, verdict) -> int:
    """What the runner says of the log it has just written."""
    told = read_run(path).metadata["run"].get("exit_reason", status.EXIT_NAMES[status.EXIT_DURATION])
    lacking = [one for one in verdict.failed if one.key == "ended_as_planned"]
    ran = len(read_run(path).tick)
    result = SimpleNamespace(
        log_path=path,
        exit_reason=status.EXIT_NAMES.index(told),
        recorder={},
        ring=SimpleNamespace(header=np.zeros(1000, np.int64), frame_count=np.zeros((2, 11), np.int64)),
        has_stimulus=False,
        armed=SimpleNamespace(
            bench=SimpleNamespace(progress=[{"tick_count": ran}]),
            loaded=SimpleNamespace(profile=parse_profile(PROFILE, "x")),
        ),
    )
    said = verdict_of_run(result)
    assert len(said["causes"]) == len(verdict.failed) - (lacking != [] and lacking[0].outcome == "not judged")
    return exit_code_of(result, said)


def test_a_log_that_is_gone_fails_the_run_and_the_rest_is_told(tmp_path):
    """Deleted, or its disk unmounted, while the run went on."""
    path = tmp_path / "run.mcap"
    MAKERS["as planned, limits kept"](path)
    verdict = judged(path)
    path.write_bytes(b"")
    with pytest.raises(HilrunnerError):
        read_run(path)
    result = SimpleNamespace(
        log_path=path,
        exit_reason=status.EXIT_CAN_LOST,
        recorder={"check": None},
        ring=SimpleNamespace(header=np.zeros(1000, np.int64), frame_count=np.zeros((2, 11), np.int64)),
        has_stimulus=True,
        armed=SimpleNamespace(
            bench=SimpleNamespace(progress=[{"tick_count": 100}]),
            loaded=SimpleNamespace(profile=parse_profile(PROFILE, "x")),
        ),
    )
    said = verdict_of_run(result)
    assert exit_code_of(result, said) == exit_codes.CAN_LOST
    assert any("limits_judged" in cause and "empty file" in cause for cause in said["causes"])
    assert verdict.passed
