"""The live view as a viewer meets it: over a WebSocket, decimated, with the log's own topics and bytes."""

import socket
import time

import mcap_doctor
import numpy as np
import pytest
from recorder_producer import ring_shape, start
from websocket_client import LiveClient

from hilrunner.base.errors import LogError
from hilrunner.record.live import _Decimator


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_viewer_gets_the_log_s_own_messages_at_a_lower_rate(tmp_path):
    port = free_port()
    block, producer, handle = start(
        tmp_path / "a.mcap", ring_shape(tick_capacity=8192), live_port=port, live_hz=20.0, statistics_hz=10.0
    )
    handle.wait_ready()
    client = LiveClient(port)
    client.expect_channels(7)
    client.subscribe()
    got = []
    while not got:  # the server says nothing when it has taken a subscription: its first message tells
        producer.publish(100)
        got += [client.message()] if client.hears(0.2) else []
    for _ in range(30):
        producer.publish(100)
        time.sleep(0.02)
    count = producer.next_tick
    producer.publish_miss(count - 50, 100_000)
    producer.end()
    handle.finish()
    with pytest.raises((EOFError, ConnectionError)):
        while True:
            got.append(client.message())
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    topics = {topic for topic, _, _ in got}
    assert topics == {"/rt/tick", "/axis_1/command", "/axis_1/state", "/rt/miss", "/rt/statistics", "/log"}
    logged = {(topic, message[1], message[3]) for topic, kept in found.messages.items() for message in kept}
    for topic, log_ns, payload in got:
        if topic != "/log":
            assert (topic, log_ns, payload) in logged, topic
    ticks = [int.from_bytes(payload[4:12], "little") for topic, _, payload in got if topic == "/axis_1/state"]
    assert ticks == list(range(ticks[0], count, 50)) and len(ticks) >= 60  # 20 Hz of 1 kHz
    shown = {c["topic"]: c for c in client.channels.values()}
    assert shown["/axis_1/state"]["encoding"] == "cdr" and shown["/axis_1/state"]["schemaEncoding"] == "ros2msg"
    assert "chamber_1_pressure_pa # Pa" in shown["/axis_1/state"]["schema"]
    assert "/axis_1/check" in shown


def test_a_port_in_use_refuses_the_run_and_leaves_no_log(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        block, producer, handle = start(tmp_path / "a.mcap", live_port=port)
        with pytest.raises(LogError, match=f"--live {port}"):
            handle.wait_ready()
    assert not (tmp_path / "a.mcap").exists()


def test_a_viewer_that_stops_reading_does_not_hold_the_recorder(tmp_path):
    port = free_port()
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(tick_capacity=8192), live_port=port, live_hz=1000.0)
    handle.wait_ready()
    client = LiveClient(port)
    client.expect_channels(7)
    client.subscribe()
    time.sleep(0.2)
    producer.publish_all(20_000)  # nobody reads the socket
    producer.end()
    summary = handle.finish()
    assert summary["tick_count"] == 20_000 and summary["dropped_ticks"] == 0


@pytest.mark.parametrize("sizes", [(1000,), (1,) * 1000, (7, 93, 400, 500)])
def test_decimation_does_not_depend_on_batches(sizes):
    decimator = _Decimator(40)
    ticks = np.delete(np.arange(1000), np.arange(200, 290))  # a gap: skipped periods
    shown = []
    first = 0
    for size in sizes:
        part = ticks[first : first + size]
        shown += [int(part[place]) for place in decimator.places(part)]
        first += size
    assert shown == [*range(0, 200, 40), 290, *range(320, 1000, 40)]
