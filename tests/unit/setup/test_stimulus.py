"""A CAN log in place of the bus: the newest valid command of each tick is held; a log that cannot serve is refused in one sentence."""

import base64
import dataclasses
import gzip

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.errors import ProfileError, UsageError
from hilrunner.realtime import command, decode
from hilrunner.setup.profile import CommandRules, load_profile
from hilrunner.setup.stimulus import aged_commands, load_stimulus, profile_stimulus, read_stimulus

FULL_OUT = "C522004078563412"  # golden: Active, 100 %, counter 2
FULL_IN = "6F2F00C0FFFFFFFF"  # golden: Active, -100 %, counter 15
HOLD = "0110000001000000"  # golden: Hold, counter 0


@pytest.fixture(scope="module")
def loaded():
    return load_profile("amc-lift")


def write_log(folder, *rows) -> str:
    path = folder / "recorded.log"
    path.write_text("".join(f"({stamp}) can0 {frame}\n" for stamp, frame in rows))
    return str(path)


def test_commands_are_held_until_the_next(tmp_path, loaded):
    log = write_log(tmp_path, ("5.000", f"201#{FULL_IN}"), ("5.0034", f"201#{HOLD}"), ("5.0054", "123#00"))
    np.testing.assert_array_equal(load_stimulus(log, loaded)[:, 0], [-1, -1, -1, 0, 0, 0])


def test_ticks_before_the_first_valid_command_are_neutral(tmp_path, loaded):
    log = write_log(tmp_path, ("5.000", "123#00"), ("5.0024", f"201#{FULL_OUT}"), ("5.0034", f"201#{FULL_IN}"))
    commands = load_stimulus(log, loaded)[:, 0]  # the second command's counter has jumped: not used
    np.testing.assert_array_equal(commands, [0, 0, 1, 1])


@pytest.mark.parametrize(("duration_s", "expected"), [(0.002, [-1, -1]), (0.005, [-1, -1, -1, 0, 0])])
def test_a_duration_cuts_or_holds(tmp_path, loaded, duration_s, expected):
    log = write_log(tmp_path, ("5.000", f"201#{FULL_IN}"), ("5.0034", f"201#{HOLD}"))
    np.testing.assert_array_equal(load_stimulus(log, loaded, duration_s)[:, 0], expected)


def test_stamps_a_little_out_of_order_are_taken(tmp_path, loaded):
    log = write_log(tmp_path, ("5.0024", "123#00"), ("5.000", f"201#{FULL_IN}"), ("5.0034", "123#00"))
    np.testing.assert_array_equal(load_stimulus(log, loaded)[:, 0], [-1, -1])


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([("9.0", "123#00"), ("1.0", "123#00")], "time goes back by 8 s at frame 2"),
        ([("1.0", "123#00"), ("9999999999.0", "123#00")], "at most 100000000 periods"),
        ([("1.0", "123#00")], "none of its 1 frames"),
    ],
)
def test_a_log_that_cannot_serve(tmp_path, loaded, rows, told):
    with pytest.raises(UsageError, match=told):
        load_stimulus(write_log(tmp_path, *rows), loaded)


@pytest.mark.parametrize("ending", ["log", "asc", "blf", "trc", "mf4"])
@pytest.mark.parametrize("content", [b"", b"garbage\n", bytes(range(256)) * 4])
def test_damaged_logs_are_one_error(tmp_path, loaded, ending, content):
    path = tmp_path / f"damaged.{ending}"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="damaged"):
        load_stimulus(str(path), loaded)


def test_a_missing_log_is_said_to_be_missing(loaded):
    with pytest.raises(UsageError, match="no such file"):
        load_stimulus("none.log", loaded)


def test_a_schedule_too_long_for_memory_is_refused(loaded):
    with pytest.raises(UsageError, match="at most 100000000 periods"):
        load_stimulus("hold", loaded, 1e7)


def full(counter_frame: str = FULL_OUT) -> str:
    return f"201#{counter_frame}"


def test_frame_k_of_a_millisecond_grid_is_the_command_of_tick_k(tmp_path, loaded):
    """Differences of Unix times in float64, cut instead of rounded, gave half of the ticks the next frame's command."""
    rows = [(f"1764300000.{k:03d}000", "123#00") for k in range(50)]
    rows[20] = ("1764300000.020000", f"201#{FULL_IN}")
    commands = load_stimulus(write_log(tmp_path, *rows), loaded)[:, 0]
    assert len(commands) == 50 and np.flatnonzero(commands)[0] == 20


def test_commands_age_in_a_gap_exactly_as_on_a_bus():
    """Every value is that of `realtime.command`, run tick by tick; Reset alone ends the latched fail-safe."""
    rng = np.random.default_rng(5)
    active, hold, reset = status.CONTROL_ACTIVE, status.CONTROL_HOLD, status.CONTROL_RESET
    for rules in (CommandRules(), CommandRules(5.0, 0.0, 0.0), CommandRules(3.0, 4.0, 20.5)):
        ticks = np.cumsum(rng.choice([0, 1, 3, 40, 70, 130, 400], 60)).tolist()
        controls = rng.choice([active, active, active, hold, reset], 60).tolist()
        setpoints = rng.uniform(-1, 1, 60).tolist()
        count = ticks[-1] + 300
        row = command.make_command_state(
            *(round(one * 1e6) for one in (rules.stale_after_ms, rules.hold_for_ms, rules.ramp_for_ms))
        )
        fresh, expected = decode.fresh_commands(1), []
        for tick in range(count):
            for index in [k for k, one in enumerate(ticks) if one == tick]:
                fresh[0]["valve_command"], fresh[0]["control"] = setpoints[index], controls[index]
                fresh[0]["valid_tick"] = tick
                command.accept(row, 0, fresh)
            expected.append(command.apply_age(row, 0, tick, 1_000_000))
        aged, longest, told = aged_commands(ticks, setpoints, controls, count, rules, 1_000_000)
        np.testing.assert_array_equal(aged, expected)
        assert longest == 400 and "stale_after_ms" in told


def test_a_firmware_that_falls_silent_in_a_recording_leaves_no_valve_open(tmp_path, loaded):
    log = write_log(tmp_path, ("5.000", full()), ("6.000", "123#00"))
    stimulus = read_stimulus(log, loaded)
    commands = stimulus.commands[:, 0]
    assert commands[0] == 1.0 and 0.0 < commands[150] < 1.0 and not commands[201:].any()
    (told,) = stimulus.facts.warnings
    assert "aged as on a bus" in told and "latched at 0.201 s, and no Reset follows" in told


def test_one_line_tells_what_was_understood(tmp_path, loaded):
    log = write_log(
        tmp_path, ("5.000", full(FULL_IN)), ("5.0034", f"201#{HOLD}"), ("5.004", "201#00"), ("5.0054", "123#00")
    )
    facts = read_stimulus(log, loaded).facts
    text = facts.text()
    for word in (
        log,
        "candump",
        "0.005 s",
        "4 frames",
        "2 valid commands on channel can0",
        "1 wrong length",
        "longest gap 0.003 s",
        "6 periods",
    ):
        assert word in text, text
    assert facts.as_dict()["valid_count"] == {"luffing": 2} and facts.warnings == ()
    schedule = read_stimulus("steps", loaded, 2.0).facts
    assert "schedule" in schedule.text() and "2000 periods" in schedule.text()
    assert schedule.as_dict()["longest_gap_s"] is None


def two_channels(folder) -> str:
    path = folder / "two.log"
    path.write_text(f"(5.000) can0 201#{FULL_OUT}\n(5.001) can1 201#{FULL_IN}\n(5.002) can2 123#00\n")
    return str(path)


def test_commands_on_two_channels_are_never_mixed(tmp_path, loaded):
    log = two_channels(tmp_path)
    with pytest.raises(UsageError, match=r"2 channels \(1 on can0, 1 on can1\).*--stimulus-channel can0"):
        read_stimulus(log, loaded)
    assert read_stimulus(log, loaded, channel="can0").commands[0, 0] == 1.0
    assert read_stimulus(log, loaded, channel="can1").commands[0, 0] == -1.0
    with pytest.raises(UsageError, match="no frame of it.*can0, can1, can2"):
        read_stimulus(log, loaded, channel="can3")


def test_other_traffic_on_other_channels_does_not_matter(tmp_path, loaded):
    log = write_log(tmp_path, ("5.000", full()))
    with open(log, "a") as file:
        file.write("(5.002) can1 123#00\n")
    facts = read_stimulus(log, loaded).facts
    assert facts.used_channels == ("can0",) and "on channel can0 (of can0, can1)" in facts.text()


def test_a_cut_log_is_read_and_told(tmp_path, loaded):
    path = tmp_path / "cut.log"
    path.write_text(f"(5.000) can0 201#{FULL_IN}\n(5.004) can0 123#00\n(5.0")
    stimulus = read_stimulus(str(path), loaded)
    assert len(stimulus.commands) == 5
    assert "its last line is cut: '(5.0'; what is whole was read" in stimulus.facts.warnings[0]


def test_a_table_of_frames_is_no_schedule_and_a_schedule_may_be_packed(tmp_path, loaded):
    table = tmp_path / "frames.csv"
    data = base64.b64encode(bytes.fromhex(FULL_OUT)).decode()
    table.write_text(f"timestamp,arbitration_id,extended,remote,error,dlc,data\n5.0,0x201,0,0,0,8,{data}\n")
    assert read_stimulus(str(table), loaded).commands.tolist() == [[1.0]]
    packed = tmp_path / "schedule.csv.gz"
    packed.write_bytes(gzip.compress(b"time_s;valve_command\r\n0;0,25\r\n0,002;0\r\n"))
    assert read_stimulus(str(packed), loaded).commands[:, 0].tolist() == [0.25, 0.25]


def test_a_name_in_another_encoding_does_no_harm_to_a_log(tmp_path, loaded):
    facts = read_stimulus("steps", loaded, 1.0).facts
    named = dataclasses.replace(facts, name="\udcfcber\n.csv")
    assert len(named.text().encode("utf-8").splitlines()) == 1


@pytest.mark.parametrize("name", ["", " ", "a" * 5000, "a" * 5000 + ".csv", "nul\0.log"])
def test_names_that_no_file_can_have(loaded, name):
    with pytest.raises((UsageError, ProfileError)):
        read_stimulus(name, loaded)
    with pytest.raises(ProfileError):
        load_profile(name)


def test_the_profile_may_name_the_channel(tmp_path):
    two_channels(tmp_path)
    path = tmp_path / "mine.toml"
    text = 'name = "mine"\n[stimulus]\nschedule = "two.log"\nchannel = "{0}"\n[[axis]]\nname = "luffing"\n'
    for channel, command_ in (("can0", 1.0), ("can1", -1.0)):
        path.write_text(text.format(channel))
        assert profile_stimulus(load_profile(str(path))).commands[0, 0] == command_
