"""Names and texts out of files never reach a terminal, a page or a CI server as commands."""

import io
import json
import xml.etree.ElementTree as ElementTree

import pytest

from hilrunner import cli
from hilrunner.base.errors import HilrunnerError
from hilrunner.base.plain_text import plain_line, plain_text
from hilrunner.commands.plain_streams import PlainStream
from hilrunner.record.mcap_log import LogWriter
from tests.tools import synthetic_run

EVIL = "\x1b]0;owned\x07\x1b[2J\r\nverdict: passed\u202egnp\u2028\x85\x00\x7f<script>&\ud800"
HARMFUL = [chr(c) for c in (*range(0x20), *range(0x7F, 0xA0)) if chr(c) not in "\n\t"] + list(
    "\u202e\u2028\ufffe\ud800"
)


def write_evil_log(path):
    """A log whose every name and text carries escapes; halves of surrogate pairs cannot stand in UTF-8."""
    evil = EVIL.replace("\ud800", "")
    tables = synthetic_run.run_metadata()
    tables["run"].update(profile=evil, exit_reason=evil, seed=evil, **{evil: evil})
    grants = [{name: evil for name in ("name", "asked", "got", "granted", "reason", "remedy")}]
    findings = [{name: evil for name in ("name", "value", "verdict", "remedy")}]
    tables["host"] = {
        "mode_label": evil,
        "mode_reasons": evil,
        "kernel": evil,
        "grants": json.dumps(grants),
        "findings": json.dumps(findings),
    }
    attachments = [("profile.toml", "text/plain", synthetic_run.PROFILE.encode()), (evil, evil, b"data")]
    log = LogWriter(path, [synthetic_run.AXIS], 8, tables, attachments)
    log.add_topic(f"/{evil}/foreign", evil, synthetic_run.records.TICK)
    tick, _ = synthetic_run.ticks_of(0, 50, synthetic_run.np.random.default_rng(1), 7777)
    log.write_records(f"/{evil}/foreign", tick, 1, 1)
    log.write_records("/rt/tick", tick, 1, 1)
    log.write_log(30, evil, evil, 1)
    log.close()
    return path


def assert_harmless(text: str) -> None:
    assert [c for c in HARMFUL if c in text] == []
    assert "\nverdict: passed" not in text


def test_a_line_stays_one_line_and_says_what_was_there():
    text = plain_line(EVIL)
    assert text == r"\x1b]0;owned\x07\x1b[2J\r\nverdict: passed\u202egnp\u2028\x85\x00\x7f<script>&\ud800"
    assert plain_text("two\nlines\tof\x1b text") == "two\nlines\tof\\x1b text"
    assert plain_text("Grüße, 20 µs, ≥ 3 × ½ … 日本") == "Grüße, 20 µs, ≥ 3 × ½ … 日本"


def test_an_error_is_one_line_of_bounded_length():
    text = str(HilrunnerError(EVIL, "x" * 1_000_000, EVIL, EVIL))
    assert "\n" not in text
    assert_harmless(text)
    assert len(text) < 10_000
    assert "998000 characters more" in text


def test_report_of_a_log_full_of_escapes(tmp_path, capsys):
    log = write_evil_log(tmp_path / "evil.mcap")
    page, junit = tmp_path / "r.html", tmp_path / "r.xml"
    cli.main(["report", str(log), "--html", str(page), "--junit", str(junit)])
    out, err = capsys.readouterr()
    for text in (out, err, page.read_text(), junit.read_text()):
        assert_harmless(text)
    assert out.count("verdict: ") > 1  # told, as an escape inside a line
    assert "<script>&" not in page.read_text()
    assert ElementTree.parse(junit).getroot().find("testsuite") is not None
    cli.main(["report", str(log), "--json"])
    text = capsys.readouterr().out
    assert_harmless(text)
    json.loads(text)


@pytest.mark.parametrize("encoding", ["utf-8", "ascii", "latin-1"])
def test_a_stream_of_any_encoding_takes_any_text(encoding):
    beneath = io.BytesIO()
    stream = PlainStream(io.TextIOWrapper(beneath, encoding=encoding, write_through=True))
    print(EVIL.replace("\n", ""), "≥ 3 µs", file=stream)  # line breaks are a matter of plain_line
    assert_harmless(beneath.getvalue().decode(encoding))
    assert stream.encoding == encoding
