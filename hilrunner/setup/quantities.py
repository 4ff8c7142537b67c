"""The quantities a message may carry, their kinds of unit, and the row of a signal that carries one."""

from fractions import Fraction

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.base.units import WIRE_UNITS
from hilrunner.setup import signal_layout
from hilrunner.setup.mapping import SignalMapping
from hilrunner.setup.signal_layout import Signal

QUANTITY_KINDS = {
    "chamber_1_pressure": "pressure",
    "chamber_2_pressure": "pressure",
    "supply_pressure": "pressure",
    "line_a_pressure": "pressure",
    "line_b_pressure": "pressure",
    "rod_position": "length",
    "rod_velocity": "velocity",
    "spool_1_position": "length",
    "spool_2_position": "length",
    "load_force": "force",
    "valve_command": "ratio",
    "bench_state": "count",
    "flags": "count",
    "tick": "count",
    "deadline_misses": "count",
    "echoed_timestamp": "timestamp",
    "heave_position": "length",
    "heave_velocity": "velocity",
}
CONTROL_NAMES = ("disabled", "hold", "active", "reset", "trip")
CURVE_POINTS_MAX = 256


def factor_of(where: str, kind: str, unit: str, mapped: SignalMapping) -> Fraction:
    """Physical value times this is SI: of the mapping's factor, else of a unit; DbcError for a unit of another kind."""
    if mapped.factor is not None:
        return Fraction(str(mapped.factor))
    if unit not in WIRE_UNITS[kind]:
        raise DbcError(
            where, f"unit '{unit}' is not one of a {kind}",
            ", ".join(f"'{name}'" for name in WIRE_UNITS[kind]), "give `unit` or `factor` in the mapping",
        )  # fmt: skip
    return Fraction(WIRE_UNITS[kind][unit])


def quantity_row(where: str, signal: Signal, mapped: SignalMapping, kind: str, modulus: bool = False) -> np.ndarray:
    """One bits.SIGNAL row for a mapped signal; with a curve the row's values stay physical."""
    if mapped.curve is not None:
        return signal_layout.row(where, signal, Fraction(1), False)
    unit = signal.unit if mapped.unit is None else mapped.unit
    return signal_layout.row(where, signal, factor_of(where, kind, unit, mapped), modulus)


def curve_of(where: str, mapped: SignalMapping, kind: str) -> np.ndarray:
    """float64[n, 2] of a mapping's curve: physical value, quantity in SI; physical values increase."""
    points = np.array(sorted(mapped.curve), np.float64).reshape(-1, 2)
    if not 2 <= len(points) <= CURVE_POINTS_MAX or not np.isfinite(points).all():
        raise DbcError(where, f"a curve of {len(points)} points", f"2..{CURVE_POINTS_MAX} finite points")
    if np.any(np.diff(points[:, 0]) <= 0):
        raise DbcError(where, "the curve has two points at one physical value", remedy="give each value one point")
    points[:, 1] *= float(factor_of(where, kind, mapped.unit or next(iter(WIRE_UNITS[kind])), mapped))
    return points


def curve_text(points: np.ndarray) -> str:
    """A curve for people, x to y; where it is flat, its inverse is not one value, and that is told."""
    shown = points if len(points) <= 8 else np.concatenate([points[:4], points[-3:]])
    text = (
        "curve "
        + ", ".join(f"{x:g} to {y:g}" for x, y in shown)
        + (f" ({len(points)} points)" if len(points) > 8 else "")
    )
    flat = [
        f"{points[k, 0]:g}..{points[k + 1, 0]:g}" for k in range(len(points) - 1) if points[k, 1] == points[k + 1, 1]
    ]
    return text + (f" (every value of {' and '.join(flat)} asks for the same)" if flat else "")
