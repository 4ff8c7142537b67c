"""The cross-check through the whole recorder: ring in, /<axis>/check and a verdict out."""

import check_plant
import mcap_doctor
import numpy as np
import pytest
from recorder_producer import Producer, ring_shape, start

from hilrunner.base import records, ring
from hilrunner.record.check_worker import CheckWorker
from hilrunner.record.config import CheckConfig
from hilrunner.record.launch import plants_file

COUNT = 1200
FAULT_TICK = 500


@pytest.fixture(scope="module")
def run():
    axis = check_plant.lift_axis()
    begin = check_plant.start_state(axis)
    # into the cache on disk first: the recorder waits a limited time for its check
    assert CheckWorker(CheckConfig(plants_file([axis], None), [begin.tolist()]), ["axis_1"], 1_000_000).finish(500.0)
    commands = 0.5 * np.sin(np.arange(COUNT) * 0.01)
    return axis, begin, commands, check_plant.run_reference(axis, commands, np.ones(COUNT), begin)


class PlantProducer(Producer):
    """Publishes a given run instead of made-up values."""

    def __init__(self, block_ring, shape, commands, states) -> None:
        super().__init__(block_ring, shape)
        ticks = np.arange(COUNT)
        self.made = check_plant.as_records(ticks, commands, np.ones(COUNT), states)

    def publish_run(self, first: int, count: int) -> None:
        part = slice(first, first + count)
        self.ring.command[part], self.ring.state[part] = self.made[0][part], self.made[1][part]
        self.ring.tick[part]["tick"] = np.arange(first, first + count)
        self.ring.tick[part]["deadline_mono_ns"] = np.arange(first, first + count) * self.period_ns
        self.ring.tick[part]["end_mono_ns"] = np.arange(first, first + count) * self.period_ns + 20_000
        self.store(ring.WORD_TICK_WRITTEN, first + count)


def record_run(tmp_path, run, states):
    axis, begin, commands, _ = run
    check = CheckConfig(
        plants_file([axis], None), [begin.tolist()], pressure_tolerance_pa=20e3, position_tolerance_m=1e-4
    )
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(tick_capacity=2048), check=check)
    handle.wait_ready(60)
    plant = PlantProducer(producer.ring, producer.shape, commands, states)
    for first in range(0, COUNT, 400):
        plant.publish_run(first, 400)
    producer.end()
    summary = handle.finish(120)
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    data = b"".join(b"\0" * 4 + message[3] for message in found.messages["/axis_1/check"])
    return producer, summary, found, np.frombuffer(data, records.CHECK)


def test_a_run_within_tolerance(tmp_path, run):
    producer, summary, found, check = record_run(tmp_path, run, run[3])
    assert (check["tick"] == np.arange(COUNT)).all()
    assert (check["chamber_1_pressure_error_pa"] == 0).all()
    assert producer.word(ring.WORD_CHECK_FAILED_TICK) == 0
    assert summary["check"]["axis_1"]["checked_ticks"] == COUNT
    assert dict(found.metadata)["check"]["axis_1.checked_ticks"] == str(COUNT)
    times = [message[1:3] for message in found.messages["/axis_1/check"]]
    assert times == [message[1:3] for message in found.messages["/axis_1/state"]]


def test_a_divergence_is_in_the_ring_the_log_and_the_summary(tmp_path, run):
    states = run[3].copy()
    states[FAULT_TICK:, 2] += 30e3
    producer, summary, found, check = record_run(tmp_path, run, states)
    assert producer.word(ring.WORD_CHECK_FAILED_TICK) == FAULT_TICK + 1
    assert summary["check"]["axis_1"]["failed_tick"] == FAULT_TICK
    assert (check["flags"][:FAULT_TICK] == 0).all() and (check["flags"][FAULT_TICK:] == 1).all()
    texts = [message[3] for message in found.messages["/log"]]
    assert sum(b"chamber 1 pressure of the free run" in text and b"tick 500" in text for text in texts) == 1
