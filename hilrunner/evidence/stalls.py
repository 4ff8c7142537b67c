"""Whether the host let the bench do its part: a bench that stood still says nothing about the firmware it tests."""

from hilrunner.base.units import NS_PER_MS
from hilrunner.setup.profile import StallLimit


def stall_problem(limit: StallLimit, count: int, longest_ns: int, first_tick: int) -> str:
    """In a sentence; empty where the profile's limit was kept, or is only to be told.

    Args:
        count: times without a served period that were longer than the limit. longest_ns: the longest of all.
        first_tick: the tick that ended the first of them.
    """
    if not count or limit.action == "warn":
        return ""
    return (
        f"its host let the bench serve no period for {longest_ns / NS_PER_MS:.1f} ms at worst, {count} times longer than the "
        f"{limit.max} ms that deadline.stall_ms allows, first before tick {first_tick}: this run says nothing about the firmware"
    )


def logged_stall_problem(table: dict[str, str], limit: StallLimit) -> str | None:
    """The same of a log's closing metadata; None where that does not tell (an earlier version, a log without its end)."""
    try:
        counts = [int(table[key]) for key in ("stall_count", "stall_ns_max", "stall_first_tick")]
    except (KeyError, ValueError):
        return None
    return stall_problem(limit, *counts)
