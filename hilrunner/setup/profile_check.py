"""Relations between the values of a profile that no single key shows."""

import json
import math
from typing import TYPE_CHECKING, Any

from hilrunner.base.errors import ProfileError, UsageError
from hilrunner.setup.fault_values import check_fault
from hilrunner.setup.limits import read_limits

if TYPE_CHECKING:
    from hilrunner.setup.profile import Axis, Fault, Load, Profile

NETWORK_SIZE_MAX_BYTES = 1 << 20


def check_numbers(value: Any, place: str, path: str) -> None:
    """TOML knows nan and inf; a bench has no use for either."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ProfileError(f"{place}: {path}", f"{value} is not a finite number", remedy="correct the value")
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        step = f"[{key}]" if isinstance(key, int) else f".{key}" if path else key
        check_numbers(inner, place, f"{path}{step}")


def check_relations(profile: "Profile", place: str) -> None:
    read_limits(profile.limits, f"{place}: limits")
    names = [axis.name for axis in profile.axis]
    if len(set(names)) != len(names):
        raise ProfileError(f"{place}: axis", f"two axes share a name in {names}", remedy="give each axis its own name")
    for index, axis in enumerate(profile.axis):
        _check_load(axis.load, f"{place}: axis[{index}].load")
        _check_range(axis, f"{place}: axis[{index}].position_range_mm")
        _check_network(axis.network, f"{place}: axis[{index}].network")
    _check_mapping(profile, place)
    for index, fault in enumerate(profile.fault):
        _check_fault(fault, names, f"{place}: fault[{index}]")
    _check_requirements(profile, names, place)
    period_ms = profile.bench.period_us / 1000
    for index, axis in enumerate(profile.axis):
        if axis.command.stale_after_ms < period_ms:
            raise ProfileError(
                f"{place}: axis[{index}].command.stale_after_ms",
                f"{axis.command.stale_after_ms} ms is shorter than one period",
                limit=f">= {period_ms} ms",
                remedy="raise it to the firmware's cycle time times the frames it may lose",
            )


def _check_requirements(profile: "Profile", names: list[str], place: str) -> None:
    from hilrunner.setup.requirement_signals import requirements_of

    try:
        requirements_of(profile.requirement, names, place)
    except UsageError as error:
        raise ProfileError(error.place, error.problem, error.limit, error.remedy) from None


def _check_range(axis: "Axis", place: str) -> None:
    if axis.position_range_mm is None:
        return
    low, high = axis.position_range_mm
    if not low <= axis.initial_position_mm <= high or low == high:
        raise ProfileError(
            place,
            f"{low:g} to {high:g} mm does not hold the initial position {axis.initial_position_mm:g} mm",
            remedy="widen the range or move the start",
        )


def _check_load(load: "Load", place: str) -> None:
    if load.kind == "constant" and load.force_kn is None:
        raise ProfileError(f"{place}.force_kn", "missing", remedy="a constant load needs force_kn")
    for key, kind, given in (
        ("force_kn", "constant", load.force_kn is not None),
        ("position_mm", "table", bool(load.position_mm)),
        ("table_force_kn", "table", bool(load.table_force_kn)),
    ):
        if given and load.kind != kind:
            raise ProfileError(
                f"{place}.{key}", f"has no effect on kind '{load.kind}'", remedy=f'remove it, or say kind = "{kind}"'
            )
    if load.kind != "table":
        return
    position, force = load.position_mm, load.table_force_kn
    if len(position) < 2 or len(position) != len(force):
        raise ProfileError(
            f"{place}.position_mm",
            f"{len(position)} positions and {len(force)} forces",
            limit="two or more of each, equally many",
            remedy="give position_mm and table_force_kn of equal length",
        )
    if any(b <= a for a, b in zip(position, position[1:], strict=False)):
        raise ProfileError(f"{place}.position_mm", "not increasing", remedy="sort the table by position")


def _check_fault(fault: "Fault", names: list[str], place: str) -> None:
    if fault.axis not in names:
        raise ProfileError(f"{place}.axis", f"no axis '{fault.axis}'", limit=", ".join(names))
    if (fault.at_s is None) == (fault.when is None):
        raise ProfileError(place, "needs exactly one of at_s and when", remedy="say when the fault begins")
    check_fault(fault, place)


def _check_network(network: dict[str, Any], place: str) -> None:
    """A description is written into the log as JSON: nothing may stand in it that JSON does not know."""
    try:
        size = len(json.dumps(network, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ProfileError(
            place, f"holds what JSON cannot say: {error}", remedy="texts, numbers, lists, tables"
        ) from None
    if size > NETWORK_SIZE_MAX_BYTES:
        raise ProfileError(place, f"{size} bytes of description", f"at most {NETWORK_SIZE_MAX_BYTES}", "keep it short")


def _check_mapping(profile: "Profile", place: str) -> None:
    """Every mapped axis belongs to one of the profile: a mapping with two axes for one is a slip."""
    if profile.can.mapping and len(profile.can.mapping) != len(profile.axis):
        raise ProfileError(
            f"{place}: can.mapping",
            f"maps {len(profile.can.mapping)} axes, the profile has {len(profile.axis)}",
            remedy="one [[can.mapping]] an axis, in the order of [[axis]]",
        )
