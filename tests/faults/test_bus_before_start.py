"""What a bus does between its opening and the first tick: gone, or in use by another bench. One line, the documented code, no log left."""

import struct

import pytest

from hilrunner.base import exit_codes
from hilrunner.setup import bus, session
from tests.tools import socket_bench


def refused(folder, ours):
    bench = socket_bench.BenchOnSocket(ours, "--log", str(folder / "run.mcap"), "--duration", "1")
    code, summary, told = bench.end(socket_bench.START_LIMIT_S)
    assert summary == {} and "Traceback" not in told and not list(folder.iterdir())
    lines = [line for line in told.splitlines() if line.startswith("hilrunner") and "compiling" not in line]
    assert len(lines) == 1, told
    return code, lines[0]


def test_a_bus_that_goes_before_the_first_tick(tmp_path):
    ours, theirs = socket_bench.peers()
    with ours:
        theirs.close()
        ours.send(b"x")  # the refusal waits for whoever asks next
        code, line = refused(tmp_path, ours)
    assert code == exit_codes.CAN_LOST and "lost before the first tick" in line and "ECONNREFUSED" in line


def test_a_bus_on_which_another_bench_sends_already(tmp_path):
    ours, theirs = socket_bench.peers()
    with ours, theirs:
        theirs.send(struct.pack("<IB3x8s", 0x281, 8, b""))
        code, line = refused(tmp_path, ours)
    assert code == exit_codes.BAD_INPUT and "another bench is on this bus" in line and "0x281" in line


@pytest.mark.parametrize("place", ["_check_interface", "_prepare_socket"])
def test_an_interface_that_goes_while_it_is_opened(monkeypatch, place):
    class Socket:
        socket = None

        def fileno(self):
            return 0

    def gone(*_):
        raise OSError(19, "No such device")

    monkeypatch.setattr("can.Bus", lambda **_: Socket())
    monkeypatch.setattr(bus, "_check_interface", lambda *_: None)
    monkeypatch.setattr(bus, place, gone)
    with pytest.raises(bus.CanError, match="lost before the first tick: ENODEV"):
        bus.open_bus("socketcan", "can7")
    assert session.open_bus is bus.open_bus
