"""`hilrunner decode`: engineering values as cantools reads them; files that python-can reads back with the same bytes."""

import can
import cantools
import numpy as np
import pytest

from hilrunner import cli
from hilrunner.base.errors import UsageError
from hilrunner.evidence.decode_frames import FrameLog, Selection, as_file
from tests.tools import contract
from tests.tools.bench_run import EVENTFUL, make_run


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("decode") / "run.mcap"
    return path, make_run(path)


def test_values_are_those_of_cantools(log):
    path, arrays = log
    frames = list(FrameLog(path, Selection()).frames())
    assert len(frames) == len(arrays["can"])
    message = contract.database().get_message_by_name("VALVE_COMMAND_1")
    for frame, row in list(zip(frames, arrays["can"], strict=True))[::37]:
        assert frame.data == bytes(row["data"][:8]) and frame.message == "VALVE_COMMAND_1" and not frame.is_sent
        decoded = message.decode(frame.data)
        assert frame.values["valve_setpoint"] == f"{decoded['valve_setpoint']:.10g} %"
        assert frame.values["control"] == str(decoded["control"])
        assert frame.time_s == pytest.approx(int(row["tick"]) * 1e-3 + 30e-6)
    assert {frame.status for frame in frames} == {"valid", "bad crc"}
    assert sum(frame.status == "bad crc" for frame in frames) == len(
        [t for t in EVENTFUL.damaged if not 1000 <= t <= 1200]
    )


def test_a_selection_by_time_and_name(log):
    frames = list(FrameLog(log[0], Selection(0.5, 0.6, ("VALVE_COMMAND_1",))).frames())
    assert 90 < len(frames) <= 101 and all(0.5 <= frame.time_s <= 0.6 for frame in frames)
    assert len(FrameLog(log[0], Selection(messages=("MOTION_1",)))) == 0
    with pytest.raises(UsageError, match="no message 'NOPE'"):
        FrameLog(log[0], Selection(messages=("NOPE",)))


@pytest.mark.parametrize("kind, suffix", [("candump", ".log"), ("asc", ".asc")])
def test_files_for_other_tools_hold_the_same_frames(log, tmp_path, kind, suffix):
    path, arrays = log
    frames = list(FrameLog(path, Selection()).frames())
    file = tmp_path / f"frames{suffix}"
    file.write_text(as_file(iter(frames), kind))
    with can.LogReader(file) as reader:
        read = list(reader)
    assert [bytes(message.data) for message in read] == [frame.data for frame in frames]
    assert all(message.arbitration_id == 0x201 and message.is_rx for message in read)
    steps = np.diff([message.timestamp for message in read])
    assert np.allclose(steps, np.diff([frame.real_s for frame in frames]), atol=2e-6)


def test_the_command_prints_and_writes(log, tmp_path, capsys):
    assert cli.main(["decode", str(log[0]), "--from", "0.1", "--to", "0.101"]) == 0
    out = capsys.readouterr().out
    assert "VALVE_COMMAND_1" in out and "valve_setpoint=" in out and "%" in out
    assert cli.main(["decode", str(log[0]), "--candump", str(tmp_path / "x.log")]) == 0
    assert (tmp_path / "x.log").read_text().count("201#") == len(log[1]["can"])
    assert cli.main(["decode", str(tmp_path / "none.mcap")]) == 2


def test_another_database_may_be_named(log, tmp_path):
    text = contract.DBC.read_text().replace("VALVE_COMMAND_1", "RENAMED_1")
    (tmp_path / "other.dbc").write_text(text)
    assert isinstance(cantools.database.load_string(text), cantools.database.Database)
    assert next(FrameLog(log[0], Selection(), tmp_path / "other.dbc").frames()).message == "RENAMED_1"
