"""Every system call of the loop fails, at every place of a run, once or for good: no tick too early, no loop without an end, a reason told.

The policy is the table in docs/realtime.md. The loop runs on a simulated kernel (`system_call_scenarios.py`).
"""

import errno

import pytest

from hilrunner.base import status
from hilrunner.realtime.clock import CALL_NAMES

FATAL = {"clock_gettime": status.EXIT_SYSTEM_CALL, "clock_nanosleep": status.EXIT_SYSTEM_CALL}
BUS = ("recvmmsg", "sendmmsg")
HARMLESS = ("getrusage", "sched_getcpu", "pread")
TICKS = 6


def trials(failed, call):
    return [(code, first, count, result) for name, code, first, count, result in failed["trials"] if name == call]


def test_the_sound_run_makes_every_call(failed):
    sound = failed["sound"]
    assert sound["reason"] == status.EXIT_DURATION and sound["ticks"] == TICKS and all(sound["calls"].values())
    assert len(failed["trials"]) > 400


def test_no_tick_begins_before_its_deadline_and_no_run_hangs(failed):
    for call, code, first, count, result in failed["trials"]:
        assert result["early"] == [] and result["reason"] > 0, (call, code, first, count)


@pytest.mark.parametrize("call", FATAL)
def test_a_clock_that_fails_ends_the_run_and_is_named(failed, call):
    for code, first, count, result in trials(failed, call):
        # a sleep that is interrupted again and again is a busy wait to its deadline, as long as that is near
        passing = code == errno.EINTR and call == "clock_nanosleep"
        assert result["reason"] == (status.EXIT_DURATION if passing else FATAL[call]), (code, first, count)
        assert result["failure"] == ([0, 0] if passing else [CALL_NAMES.index(call), code])
        assert passing or result["ticks"] < TICKS or first > 50, "and no tick runs after it"


@pytest.mark.parametrize("call", BUS)
def test_a_bus_call_that_fails_is_a_lost_bus_unless_it_may_pass(failed, call):
    waits = {errno.EAGAIN} | ({errno.ENOBUFS, 0} if call == "sendmmsg" else set())
    for code, first, count, result in trials(failed, call):
        passing = code in waits or (code == errno.EINTR and count == 1)
        assert result["reason"] == (status.EXIT_DURATION if passing else status.EXIT_CAN_LOST), (code, first, count)
        assert result["bus_errno"] == (0 if passing else code)
        if call == "sendmmsg" and code in waits:
            assert result["unsent"] == 2 * (1 if count == 1 else TICKS - first + 1), "what was not sent is counted"


@pytest.mark.parametrize("call", HARMLESS)
def test_a_count_that_cannot_be_read_costs_an_explanation_and_nothing_else(failed, call):
    assert {result["reason"] for *_, result in trials(failed, call)} == {status.EXIT_DURATION}
