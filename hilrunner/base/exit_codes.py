"""The documented exit codes; the same numbers stand in the README and in `hilrunner --help`."""

from collections.abc import Iterable

PASSED = 0  # done, and the verdict (if any) passed
VERDICT_FAILED = 1  # a limit was broken or could not be judged, or part of the run is missing in the log
BAD_INPUT = 2  # usage, profile, model, DBC, log
DEADLINE_BUDGET_EXCEEDED = 3  # more or worse late ticks than the profile allows, action "stop"
CAN_LOST = 4  # interface missing, down, or removed during the run
CROSS_CHECK_FAILED = 5  # the surrogate left the tolerance around the first-principle model
REALTIME_REFUSED = 6  # --require-realtime, and the host did not grant it
DAMAGED = 7  # parts of a log do not match their own checksums or hashes: it proves nothing
BENCH_FAILED = 8  # the host stalled longer than the profile allows: the run says nothing about the firmware

# when several causes hold, all are told, and the exit code is the first of these that holds
PRECEDENCE = (DAMAGED, CAN_LOST, BENCH_FAILED, DEADLINE_BUDGET_EXCEEDED, CROSS_CHECK_FAILED, VERDICT_FAILED)


def gravest(codes: Iterable[int]) -> int:
    """The exit code of a run or log for which all of `codes` hold; PASSED where none is of PRECEDENCE."""
    held = set(codes)
    return next((code for code in PRECEDENCE if code in held), PASSED)
