"""A recorder that runs into its own trouble still finishes the log and says what it was."""

import json
import os

import mcap_doctor
import pytest
from recorder_producer import Producer, ring_shape

from hilrunner.base import ring, status
from hilrunner.record import launch, process
from hilrunner.record import recorder as recorder_module
from hilrunner.record.config import Attachment, CheckConfig, RecorderConfig, decode, encode
from hilrunner.record.drain import Drain
from hilrunner.record.recorder import Recorder


@pytest.fixture
def bench(tmp_path):
    shape = ring_shape()
    block, block_ring = launch.create_ring(shape)
    settings = RecorderConfig(block.fd, list(shape), ["boom"], 1_000_000, os.getpid(), str(tmp_path / "a.mcap"))
    producer = Producer(block_ring, shape)
    producer.publish(100)
    producer.end()
    return Recorder(settings, Drain(block_ring, shape), process.open_log(settings))


class Watch:
    died = False

    def wait(self, timeout_ms: int) -> None:
        del timeout_ms


class Fails:
    """Whatever is asked of it fails."""

    def __getattr__(self, name):
        def fail(*_):
            raise OSError(5, f"{name} failed")

        return fail


def test_a_run_in_this_process_as_the_others_are_judged(bench, tmp_path, capsys):
    assert process.record(bench, Watch()) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["tick_count"] == 100 and summary["error"] is None
    assert mcap_doctor.examine(tmp_path / "a.mcap").faults == []


def test_an_error_while_draining_ends_with_a_finished_log(bench, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(recorder_module, "statistics_record", lambda *_: 1 / 0)
    assert process.record(bench, Watch()) == 1
    summary = json.loads(capsys.readouterr().out)
    assert "ZeroDivisionError" in summary["error"][1]
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert len(found.messages["/rt/tick"]) == 100
    assert "ZeroDivisionError" in dict(found.metadata)["run"]["recorder_error"]
    assert any(b"recorder failed: ZeroDivisionError" in message[3] for message in found.messages["/log"])


def test_a_live_view_that_fails_is_given_up(bench, tmp_path, capsys):
    bench.live = Fails()
    assert process.record(bench, Watch()) == 0
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    texts = [message[3] for message in found.messages["/log"]]
    assert sum(b"live view stopped: OSError" in text for text in texts) == 1


def test_a_check_that_fails_is_told_in_the_log(bench, tmp_path, capsys):
    bench.check = recorder_module.CheckWorker(CheckConfig(str(tmp_path / "none"), []), ["boom"], 1_000_000)
    assert process.record(bench, Watch()) == 0
    summary = json.loads(capsys.readouterr().out)
    assert "FileNotFoundError" in summary["check"]["error"] and summary["check"]["left_out_ticks"] >= 0
    texts = [message[3] for message in mcap_doctor.examine(tmp_path / "a.mcap").messages["/log"]]
    assert sum(b"cross-check stopped: FileNotFoundError" in text for text in texts) == 1


def test_the_newest_word_of_the_runner_is_the_reason(bench, capsys):
    bench.drain.store(ring.WORD_EXIT_REASON, status.EXIT_CAN_LOST)
    process.record(bench, Watch())
    assert json.loads(capsys.readouterr().out)["exit_reason"] == "CAN lost"


def test_configuration_survives_the_pipe():
    settings = RecorderConfig(
        3,
        [1, 2, 4, 4, 8, 10, 100],
        ["a", "ö"],
        1_000_000,
        42,
        "x.mcap",
        {"run": {"a": "b"}},
        [Attachment("p", "text/plain", text="ä\n"), Attachment("q", "text/plain", path="/q")],
        check=CheckConfig("plants", [[0.1] * 10], pressure_tolerance_pa=1e4),
        cpus=[0],
        live_port=8765,
    )
    assert decode(encode(settings)) == settings
    with pytest.raises(TypeError):
        decode(encode(settings).replace('"live_hz"', '"live_herz"'))
