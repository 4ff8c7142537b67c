"""What comes out of a log is what went in, whatever its compression, version or topics."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

from hilrunner.base import records
from hilrunner.base.errors import LogError
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.schema import layout_of
from tests.tools import synthetic_run
from tests.tools.copy_log import copy_with


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A short run: (path, arrays as written)."""
    blocks = {}
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    synthetic_run.write_run(path, 3000, stall_every=700, edit=blocks.update)
    return path, blocks


def assert_same_run(run, blocks):
    for name, topic in (("tick", "/rt/tick"), ("command", "/lift/command"), ("state", "/lift/state")):
        assert run.topics[topic].tobytes() == blocks[name].tobytes()
    assert run.topics["/lift/check"].tobytes() == blocks["check"].tobytes()
    assert run.miss.tobytes() == blocks["miss"].tobytes()
    sent = (blocks["can"]["flags"] & records.CAN_FRAME_SENT) != 0
    assert run.can_tx.tobytes() == blocks["can"][sent].tobytes()
    assert run.can_rx.tobytes() == blocks["can"][~sent].tobytes()


def test_reads_back_every_bit(written):
    path, blocks = written
    run = read_run(path)
    assert_same_run(run, blocks)
    assert run.damage == ()
    assert run.finished
    assert run.axis_names == ("lift",)
    assert run.attachments["profile.toml"].text.startswith('name = "synthetic"')
    assert run.metadata["host"]["mode_label"] == "simulated clock"
    assert [event.text for event in run.events] == ["synthetic run"]
    assert run.start_publish_ns == synthetic_run.START_REAL_NS


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4, "chunk_size": 30_000},
        {"compression": CompressionType.ZSTD},
        {"use_chunking": False},
    ],
    ids=["plain chunks", "lz4", "zstd", "no chunks"],
)
def test_reads_what_other_writers_write(written, tmp_path, options):
    path, blocks = written
    assert_same_run(read_run(copy_with(path, tmp_path / "copy.mcap", **options)), blocks)


def test_agrees_with_an_independent_decoder(written):
    path, _ = written
    run = read_run(path)
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        rows = [row for *_, row in reader.iter_decoded_messages(topics=["/lift/state"])]
    assert len(rows) == len(run.state["lift"])
    for name in records.STATE.names[2:]:
        assert np.array_equal([getattr(row, name) for row in rows], run.state["lift"][name])


def test_keeps_only_the_columns_asked_for(written):
    path, blocks = written
    run = read_run(path, {"/rt/tick": ("tick", "end_mono_ns"), "/*/state": ("flags",)})
    assert set(run.topics) == {"/rt/tick", "/lift/state"}
    assert run.tick.dtype.names == ("tick", "end_mono_ns")
    assert np.array_equal(run.tick["end_mono_ns"], blocks["tick"]["end_mono_ns"])
    assert np.array_equal(run.state["lift"]["flags"], blocks["state"]["flags"])


def test_another_version_is_read_as_far_as_names_agree(tmp_path):
    older = np.dtype([("tick", "<u8"), ("spare", "u1"), ("rod_position_m", "<f8")], align=True)
    rows = np.zeros(50, older)
    rows["tick"] = np.arange(50)
    rows["rod_position_m"] = np.linspace(0, 1, 50)
    path = tmp_path / "older.mcap"
    with open(path, "wb") as out:
        writer = Writer(out)
        writer.start()
        text = b"uint64 tick # grid\nuint8 spare\nfloat64 rod_position_m # m\n"
        channel = writer.register_channel("/lift/state", "cdr", writer.register_schema("x/State", "ros2msg", text))
        for k, row in enumerate(rows):
            writer.add_message(channel, k, b"\0\1\0\0" + row.tobytes(), k)
        writer.finish()
    run = read_run(path)
    state = run.state["lift"]
    assert state.dtype == records.STATE
    assert np.array_equal(state["rod_position_m"], rows["rod_position_m"])
    assert not state["rod_velocity_mps"].any()
    assert any("another version" in text and "rod_velocity_mps" in text for text in run.damage)


def test_layout_follows_cdr_alignment():
    layout = layout_of("uint8 a\nfloat64 b # m\nuint16[3] c\nuint32 d\n")
    assert [layout.fields[name][1] - 8 for name in "abcd"] == [0, 8, 16, 24]
    assert layout.itemsize == 8 + 28
    assert layout_of("string name\n") is None
    assert layout_of("") is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty file (0 bytes)"),
        (b"\x89MCA", "cut off after 4 bytes"),
        (b"%PDF-1.7 nothing of ours", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "holds no topics"),
        (b"\x89MCAP0\r\n" + b"\0" * 64, "holds no topics"),
    ],
    ids=["empty", "cut magic", "pdf", "magic only", "zeros"],
)
def test_what_is_no_log_is_refused_in_words(tmp_path, content, words):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=words.replace("(", r"\(").replace(")", r"\)")):
        read_run(path)


def test_a_foreign_log_is_refused_with_its_topics(tmp_path):
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    channel = writer.register_channel("/camera", "json", writer.register_schema("x", "jsonschema", b"{}"))
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    path = tmp_path / "foreign.mcap"
    path.write_bytes(out.getvalue())
    with pytest.raises(LogError, match="/camera"):
        read_run(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(LogError, match="cannot be read"):
            read_run(path)


def test_a_log_of_ours_without_a_tick_is_not_called_foreign(tmp_path):
    from hilrunner.record.mcap_log import LogWriter

    path = tmp_path / "x.mcap"
    LogWriter(path, ["luffing"], 8, {"run": {}, "host": {}}, []).close()
    with pytest.raises(LogError, match="holds no tick: the run ended before its first tick"):
        read_run(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.index(b"/rt/tick") + 200])
    with pytest.raises(LogError, match="cut off"):
        read_run(path)
