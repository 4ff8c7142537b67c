"""The documented exit codes; the same numbers stand in the README and in `hilrunner --help`."""

PASSED = 0  # done, and the verdict (if any) passed
VERDICT_FAILED = 1  # the run ended as planned, a limit of the profile was broken
BAD_INPUT = 2  # usage, profile, model, DBC, log
DEADLINE_BUDGET_EXCEEDED = 3  # more or worse late ticks than the profile allows, action "stop"
CAN_LOST = 4  # interface missing, down, or removed during the run
CROSS_CHECK_FAILED = 5  # the surrogate left the tolerance around the first-principle model
REALTIME_REFUSED = 6  # --require-realtime, and the host did not grant it
