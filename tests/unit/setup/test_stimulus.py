"""A CAN log in place of the bus: the newest valid command of each tick is held; a log that cannot serve is refused in one sentence."""

import numpy as np
import pytest

from hilrunner.base.errors import UsageError
from hilrunner.setup.profile import load_profile
from hilrunner.setup.stimulus import load_stimulus

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
