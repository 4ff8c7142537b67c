"""The log as others read it: `mcap`, `mcap-ros2-support`, and a checker written from the specification."""

import mcap_doctor
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recorder_producer import START_MONO_NS, START_REAL_NS, periods

from hilrunner.base import records
from hilrunner.base.errors import LogError
from hilrunner.record import schemas
from hilrunner.record.levels import LOG_LEVEL_ERROR
from hilrunner.record.mcap_log import LogWriter

PERIOD_NS = 1_000_000
OFFSET_NS = START_REAL_NS - START_MONO_NS


def random_records(dtype: np.dtype, count: int, seed: int = 1) -> np.ndarray:
    """Random bits in every field (finite floats), so that a shifted or swapped byte cannot hide."""
    rng = np.random.default_rng(seed)
    made = records.allocate(dtype, count)
    for name in dtype.names[2:]:
        field = dtype.fields[name][0]
        shape = (count, *field.shape)
        if field.base.kind == "f":
            made[name] = rng.normal(size=shape) * 10.0 ** rng.integers(-9, 9, shape)
        else:
            limits = np.iinfo(field.base)
            made[name] = rng.integers(limits.min, limits.max, shape, field.base, endpoint=True)
    return made


def decoded(path):
    """(topic, MCAP message, decoded message) in file order, by the independent decoder."""
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(channel.topic, message, one) for _, channel, message, one in reader.iter_decoded_messages()]


def assert_same_bits(message, record, dtype) -> None:
    for name in dtype.names[2:]:
        value = getattr(message, name)
        field = dtype.fields[name][0]
        again = np.frombuffer(bytes(value), "u1") if isinstance(value, bytes) else np.asarray(value, field.base)
        assert again.tobytes() == record[name].tobytes(), name


@pytest.mark.parametrize(
    "topic, dtype",
    [
        ("/rt/tick", records.TICK),
        ("/boom/command", records.COMMAND),
        ("/boom/state", records.STATE),
        ("/boom/check", records.CHECK),
        ("/rt/miss", records.MISS),
        ("/rt/statistics", records.STATISTICS),
        ("/can/rx", records.CAN_FD_FRAME),
        ("/can/tx", records.CAN_FD_FRAME),
    ],
)
def test_every_field_is_decoded_bit_for_bit(tmp_path, topic, dtype):
    made = random_records(dtype, 20)
    log = LogWriter(tmp_path / "a.mcap", ["boom"], can_data_size=64)
    log.write_records(topic, made, np.arange(20) + START_REAL_NS, np.arange(20))
    log.close()
    assert mcap_doctor.examine(tmp_path / "a.mcap").faults == []
    found = decoded(tmp_path / "a.mcap")
    assert [one[0] for one in found] == [topic] * 20
    for record, (_, message, one) in zip(made, found, strict=True):
        assert_same_bits(one, record, dtype)
        assert message.data == record.tobytes()[records.MESSAGE_OFFSET :]


def test_periods_of_two_axes_with_their_frames(tmp_path):
    tick, command, state, can = periods(0, 700, axis_count=2, period_ns=PERIOD_NS)
    log = LogWriter(tmp_path / "a.mcap", ["boom", "jib"])
    log.write_can(can, START_MONO_NS, START_REAL_NS)
    log.write_ticks(tick, command, state, START_MONO_NS, START_REAL_NS)
    log.close()
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    for topic, made in [
        ("/rt/tick", tick),
        ("/boom/command", command[0::2]),
        ("/jib/command", command[1::2]),
        ("/boom/state", state[0::2]),
        ("/jib/state", state[1::2]),
        ("/can/rx", can[can["flags"] == 0]),
        ("/can/tx", can[can["flags"] == records.CAN_FRAME_SENT]),
    ]:
        data = b"".join(message[3] for message in found.messages[topic])
        assert data == np.frombuffer(made.tobytes(), "u1").reshape(len(made), -1)[:, 4:].tobytes(), topic
    _, log_ns, publish_ns, _ = np.array([(m[0], m[1], m[2], 0) for m in found.messages["/jib/state"]], dtype=np.int64).T
    assert (log_ns == tick["end_mono_ns"] + OFFSET_NS).all()
    assert (publish_ns == tick["deadline_mono_ns"] + OFFSET_NS).all()
    first_frame = found.messages["/can/rx"][0]
    assert first_frame[1] == can["mono_ns"][0] + OFFSET_NS
    assert first_frame[2] == can["kernel_real_ns"][0]


def test_a_frame_without_kernel_stamp_is_published_when_handled(tmp_path):
    *_, can = periods(0, 1, 1, PERIOD_NS)
    can["kernel_real_ns"] = 0
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    log.write_can(can, START_MONO_NS, START_REAL_NS)
    log.close()
    for topic, message, _ in decoded(tmp_path / "a.mcap"):
        assert message.publish_time == message.log_time, topic


def test_a_miss_stands_at_the_end_of_its_tick(tmp_path):
    miss = random_records(records.MISS, 1)
    miss["tick"] = 41
    miss["lateness_ns"] = 250_000
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    log.write_miss(miss, START_REAL_NS, PERIOD_NS)
    log.close()
    ((_, message, _),) = decoded(tmp_path / "a.mcap")
    assert message.publish_time == START_REAL_NS + 41 * PERIOD_NS
    assert message.log_time == START_REAL_NS + 42 * PERIOD_NS + 250_000


def test_events_in_words_follow_the_ros_log_message(tmp_path):
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    texts = ["", "ä", "four", "a longer text, odd length"]
    for text in texts:
        log.write_log(LOG_LEVEL_ERROR, "check", text, START_REAL_NS + 5)
    log.close()
    found = decoded(tmp_path / "a.mcap")
    assert [one.msg for _, _, one in found] == texts
    for topic, message, one in found:
        assert (topic, message.log_time, one.level, one.name) == ("/log", START_REAL_NS + 5, 40, "check")
        assert one.stamp.sec * 10**9 + one.stamp.nanosec == START_REAL_NS + 5


def test_metadata_and_attachments(tmp_path):
    log = LogWriter(
        tmp_path / "a.mcap",
        ["boom"],
        metadata={"run": {"profile": "x", "seed": 3}, "host": {"kernel": "6"}},
        attachments=[("profile.toml", "application/toml", b"a = 1\n"), ("empty", "text/plain", b"")],
    )
    log.close({"run": {"profile": "x", "exit_reason": "duration reached"}})
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert found.metadata == [
        ("run", {"profile": "x", "seed": "3"}),
        ("host", {"kernel": "6"}),
        ("run", {"profile": "x", "exit_reason": "duration reached"}),
    ]
    assert found.attachments == {"profile.toml": b"a = 1\n", "empty": b""}
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [one.name for one in reader.iter_metadata()] == ["run", "host", "run"]
        assert [one.data for one in reader.iter_attachments()] == [b"a = 1\n", b""]


def test_a_topic_of_one_s_own_beside_the_run(tmp_path):
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    log.add_topic("/boom/ida", "State", records.STATE)
    made = random_records(records.STATE, 3)
    log.write_records("/boom/ida", made, START_REAL_NS, START_REAL_NS)
    log.close()
    assert mcap_doctor.examine(tmp_path / "a.mcap").faults == []
    assert log.message_counts()["/boom/ida"] == 3
    for record, (_, _, one) in zip(made, decoded(tmp_path / "a.mcap"), strict=True):
        assert_same_bits(one, record, records.STATE)


def test_a_run_without_a_tick_is_a_finished_log(tmp_path):
    LogWriter(tmp_path / "a.mcap", ["boom"]).close()
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert sum(map(len, found.messages.values())) == 0


def test_chunks_close_by_size_and_by_flush(tmp_path):
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    for first in range(0, 3000, 100):
        tick, command, state, _ = periods(first, 100, 1, PERIOD_NS)
        log.write_ticks(tick, command, state, START_MONO_NS, START_REAL_NS)
        if first == 0:
            log.flush()
    log.flush()
    log.flush()  # nothing pending: no chunk
    log.close()
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert found.chunk_count == 2
    assert len(found.messages["/rt/tick"]) == 3000


@pytest.mark.parametrize("place", ["missing/folder/a.mcap", "", "../{name}"])
def test_a_log_that_cannot_be_written_is_refused_with_its_place(tmp_path, place):
    with pytest.raises(LogError) as caught:
        LogWriter(tmp_path / place.format(name=tmp_path.name), ["boom"])
    assert str(tmp_path) in str(caught.value)
    assert "--no-log" in caught.value.remedy


def test_a_device_is_no_log():
    with pytest.raises(LogError, match="not a regular file"):
        LogWriter("/dev/full", ["boom"])


def test_schemas_name_the_unit_of_every_field_that_has_one():
    assert "float64 chamber_1_pressure_pa # Pa, gauge\n" in schemas.schema_text("State", records.STATE)
    assert "int64 step_ns_p99 # ns\n" in schemas.schema_text("Statistics", records.STATISTICS)
    for message, dtype in [("Tick", records.TICK), ("State", records.STATE), ("Check", records.CHECK)]:
        for line in schemas.schema_text(message, dtype).splitlines():
            field = line.split()[1]
            if field.rsplit("_", 1)[-1] in ("ns", "us", "m", "mps", "pa", "n"):
                assert " # " in line, line
