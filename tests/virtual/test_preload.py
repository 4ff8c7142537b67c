"""Every way in which a program may meet time and CAN, on a clock that stands still between its sleeps: tests/virtual/probe.c, driven here.

The driver ticks every millisecond and sends frame 0x100 at each fifth tick; a program woken at that very moment finds it.
"""

import ctypes
import subprocess
import time
from pathlib import Path

import pytest

from hilrunner.base.errors import UsageError
from hilrunner.virtual.program import check_program
from hilrunner.virtual.world import START_MONO_NS, Firmware, VirtualBus, World

PERIOD_NS = 1_000_000
TICKS = 40
IDEAL = (VirtualBus(),)


@pytest.fixture(scope="module")
def probe(tmp_path_factory):
    """The probe, compiled."""
    program = tmp_path_factory.mktemp("probe") / "probe"
    source = Path(__file__).with_name("probe.c")
    line = ["cc", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-o", str(program), str(source), "-lpthread"]
    subprocess.run(line, check=True)
    return program


class Driver:
    """Ticks a world without a plant: frame 0x100 every five ticks."""

    def __init__(self, world: World, buses: int = 1) -> None:
        self.world = world
        self.received: list[tuple[int, int]] = []  # (tick, identifier)
        self._frames = (ctypes.c_uint8 * (72 * 1024))()
        self._sizes = (ctypes.c_int64 * 1024)()
        self._stamps = (ctypes.c_int64 * 1024)()

    def run(self, ticks: int = TICKS) -> str:
        """The ticks; why it came to a stand, or an empty text."""
        library = self.world._library
        for tick in range(ticks):
            if library.vb_advance(self.world.hub, START_MONO_NS + tick * PERIOD_NS):
                return self.world.failure()
            count = library.vb_receive(self.world.hub, self._frames, self._sizes, self._stamps, 1024)
            for k in range(count):
                self.received.append((tick, int.from_bytes(bytes(self._frames[72 * k : 72 * k + 4]), "little")))
            if tick % 5 == 0 and tick > 0:
                frame = (ctypes.c_uint8 * 72)(0x00, 0x01, 0, 0, 1)
                library.vb_send(self.world.hub, frame, (ctypes.c_int64 * 1)(16), 1)
        return ""


def drive(probe, name, capfd, *, buses=IDEAL, ticks=TICKS, wall_limit_s=20.0):
    """(what the probe printed as (time in us, word, value), the driver, why it stood, how the firmware ended)."""
    world = World(buses, [Firmware([str(probe), name])], wall_limit_s)
    try:
        world.start()
        driver = Driver(world)
        failure = driver.run(ticks)
        (end,) = world.stop()
    finally:
        world.close()
    said = [line.split(" ", 1) for line in capfd.readouterr().out.splitlines()]
    rows = [(int(stamp), *rest.rsplit(" ", 1)) for stamp, rest in said]
    return [(stamp, word, int(value)) for stamp, word, value in rows], driver, failure, end


EXPECTED = {
    "poll": [(2000, "poll", 0), (5000, "poll", 1), (5000, "readable", 1), (5000, "read", 16), (5000, "id", 0x100), (5000, "writable", 1)],
    "select": [(2000, "select", 0), (5000, "select", 1), (5000, "isset", 1)],
    "epoll": [(3000, "timer", 1), (5000, "frame", 16), (6000, "timer", 1), (9000, "timer", 1), (10000, "frame", 16), (12000, "timer", 1)],
    "timer": [(1000, "size", 8), (1000, "count", 1), (8000, "size", 8), (8000, "count", 3)],
    "message": [(5000, "size", 16), (5000, "interface", 1), (5000, "age_ns", 0)],
    "timeout": [(4000, "timed out", 1)],
    "dup": [(5000, "dup", 16), (5000, "closed", -1)],
    "flood": [(0, "no buffer space", 1), (1000, "room again", 16)],
    "broadcast": [(0, "no such protocol", 1)],
    "filters": [
        (12000, "filtered", -1), (12000, "sent", 16), (12000, "sent", 16), (13000, "own", 16), (13000, "again", -1), (13000, "looped", 2),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_a_program_sees_the_time_and_the_frames_it_would_see(probe, name, capfd):
    said, _, failure, end = drive(probe, name, capfd)
    assert (failure, said) == ("", EXPECTED[name])
    assert end.exit_code == 0


def test_frames_of_a_program_reach_the_tick_after(probe, capfd):
    _, driver, _, _ = drive(probe, "filters", capfd)
    assert driver.received == [(13, 0x321), (13, 0x322)]  # sent at 12 ms, when tick 12 had run


def test_clocks_agree_and_sleeps_are_as_long_as_asked(probe, capfd):
    began = time.monotonic()
    said, _, _, _ = drive(probe, "clocks", capfd, ticks=3_100)
    assert said == [(0, "same", 1), (1_000_000, "second", 1), (3_000_000, "absolute", 2)]
    assert time.monotonic() - began < 3.0 or len(said) == 3  # three seconds of its time are not three of ours


def test_a_program_that_looks_without_sleeping_sees_time_pass(probe, capfd):
    said, _, failure, _ = drive(probe, "busy", capfd)
    assert failure == "" and [(word, value) for _, word, value in said] == [("got", 1), ("passed", 1)]


@pytest.mark.parametrize(
    ("name", "reason"),
    [("thread", "second thread"), ("fork", "second process"), ("alarm", "signal after a time")],
)
def test_what_cannot_be_followed_is_refused_by_name(probe, name, reason, capfd):
    _, _, failure, end = drive(probe, name, capfd)
    assert "virtual time cannot follow" in failure and reason in failure
    assert reason in end.refusal


def test_a_program_that_hangs_is_ended(probe, capfd):
    _, _, failure, end = drive(probe, "hang", capfd, wall_limit_s=0.2)
    assert "did not sleep" in failure
    assert end.exit_code is None


def test_each_bus_has_its_own_frames(probe, capfd):
    said, _, _, _ = drive(probe, "buses", capfd, buses=(VirtualBus("vcan0"), VirtualBus("vcan1")))
    assert [(word, value) for _, word, value in said] == [("first", 16), ("second", -1)]


def test_the_lower_identifier_gets_the_bus(probe, capfd):
    said, driver, _, _ = drive(probe, "arbitration", capfd, buses=(VirtualBus(bitrate=125_000),))
    complete = [(stamp, value) for stamp, word, value in said if word == "complete"]
    assert [value for _, value in complete] == [0x500, 0x050, 0x400]
    # two data bytes, 11-bit identifier, worst case of stuffing: 34 + 16 + 12 + 13 bits of 8 us
    bits = 34 + 16 + (34 + 16 - 1) // 4 + 13
    assert [stamp for stamp, _ in complete] == [1000 + k * bits * 8 for k in (1, 2, 3)]
    assert [value for _, value in driver.received] == [0x500, 0x050, 0x400]


def test_an_interface_that_does_not_exist_is_none(probe, capfd):
    _, _, failure, end = drive(probe, "poll", capfd, buses=(VirtualBus("can7"),))
    assert failure == "" and end.exit_code == 1


def test_a_program_ends_and_a_script_starts_the_next(probe, capfd):
    script = f"{probe} poll; sleep 0.01; {probe} message"
    world = World([VirtualBus()], [Firmware(["/bin/sh", "-c", script])])
    try:
        world.start()
        assert Driver(world).run(60) == ""
        (end,) = world.stop()
    finally:
        world.close()
    assert end.exit_code == 0
    assert [line.split()[0] for line in capfd.readouterr().out.splitlines()][
        -1
    ] == "20000"  # 5 + 10 ms, then the next frame


def test_a_static_program_is_refused(tmp_path):
    source = tmp_path / "empty.c"
    source.write_text("int main(void) { return 0; }\n")
    subprocess.run(["cc", "-static", "-o", str(tmp_path / "static"), str(source)], check=True)
    with pytest.raises(UsageError, match="linked statically"):
        check_program(str(tmp_path / "static"))


@pytest.mark.parametrize(
    ("content", "problem"), [(b"\x00\x01plain", "neither a program"), (b"#!/no/such/interpreter\n", "no such program")]
)
def test_what_is_no_program_is_refused(tmp_path, content, problem):
    path = tmp_path / "firmware"
    path.write_bytes(content)
    path.chmod(0o755)
    with pytest.raises(UsageError, match=problem):
        check_program(str(path))


def test_what_is_not_there_is_refused():
    with pytest.raises(UsageError, match="no such program"):
        World([VirtualBus()], [Firmware(["./no-such-firmware"])])
