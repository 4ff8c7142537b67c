"""Units of requirements: what a number in a formula means in SI, and which quantities may be compared.

A dimension is a product of powers of base quantities, kept as exponents of (m, kg, s, rad, degC, A, bit). Temperatures are differences or
readings in degC; nothing here adds kelvins.
"""

from typing import NamedTuple

BASES = ("m", "kg", "s", "rad", "degC", "A", "bit")
Dimension = tuple[int, ...]
NONE: Dimension = (0,) * len(BASES)


def _dimension(**powers: int) -> Dimension:
    return tuple(powers.get(base, 0) for base in BASES)


class Unit(NamedTuple):
    """A unit of a formula: `factor` times a number gives SI."""

    factor: float
    dimension: Dimension


_LENGTH = _dimension(m=1)
_TIME = _dimension(s=1)
_FORCE = _dimension(m=1, kg=1, s=-2)
_PRESSURE = _dimension(m=-1, kg=1, s=-2)
_SPEED = _dimension(m=1, s=-1)
_FLOW = _dimension(m=3, s=-1)
_POWER = _dimension(m=2, kg=1, s=-3)

UNITS: dict[str, Unit] = {
    "m": Unit(1.0, _LENGTH),
    "mm": Unit(1e-3, _LENGTH),
    "um": Unit(1e-6, _LENGTH),
    "s": Unit(1.0, _TIME),
    "ms": Unit(1e-3, _TIME),
    "us": Unit(1e-6, _TIME),
    "ns": Unit(1e-9, _TIME),
    "min": Unit(60.0, _TIME),
    "kg": Unit(1.0, _dimension(kg=1)),
    "t": Unit(1e3, _dimension(kg=1)),
    "N": Unit(1.0, _FORCE),
    "kN": Unit(1e3, _FORCE),
    "Pa": Unit(1.0, _PRESSURE),
    "kPa": Unit(1e3, _PRESSURE),
    "MPa": Unit(1e6, _PRESSURE),
    "bar": Unit(1e5, _PRESSURE),
    "m/s": Unit(1.0, _SPEED),
    "mm/s": Unit(1e-3, _SPEED),
    "m/s2": Unit(1.0, _dimension(m=1, s=-2)),
    "mm/s2": Unit(1e-3, _dimension(m=1, s=-2)),
    "MPa/s": Unit(1e6, _dimension(m=-1, kg=1, s=-3)),
    "bar/s": Unit(1e5, _dimension(m=-1, kg=1, s=-3)),
    "L/min": Unit(1e-3 / 60.0, _FLOW),
    "m3/s": Unit(1.0, _FLOW),
    "W": Unit(1.0, _POWER),
    "kW": Unit(1e3, _POWER),
    "rad": Unit(1.0, _dimension(rad=1)),
    "deg": Unit(0.017453292519943295, _dimension(rad=1)),
    "rad/s": Unit(1.0, _dimension(rad=1, s=-1)),
    "deg/s": Unit(0.017453292519943295, _dimension(rad=1, s=-1)),
    "degC": Unit(1.0, _dimension(degC=1)),
    "A": Unit(1.0, _dimension(A=1)),
    "mA": Unit(1e-3, _dimension(A=1)),
    "Hz": Unit(1.0, _dimension(s=-1)),
    "%": Unit(0.01, NONE),
    "1": Unit(1.0, NONE),
}

# what a person would want to read a margin in, by dimension
_READABLE = ("mm", "MPa", "mm/s", "kN", "ms", "mm/s2", "L/min", "kW", "deg", "deg/s", "degC", "mA", "kg", "MPa/s", "Hz")

# the unit at the end of a field of the log -> unit of a formula
SUFFIXES: dict[str, str] = {
    "m": "m", "mps": "m/s", "mps2": "m/s2", "pa": "Pa", "n": "N", "ns": "ns", "us": "us", "s": "s", "rad": "rad", "radps": "rad/s",
    "c": "degC", "a": "A", "kg": "kg", "m3ps": "m3/s", "w": "W", "hz": "Hz",
}  # fmt: skip


def times(one: Dimension, other: Dimension, sign: int = 1) -> Dimension:
    """Dimension of a product, or of a quotient with sign -1."""
    return tuple(a + sign * b for a, b in zip(one, other, strict=True))


def readable(dimension: Dimension) -> tuple[str, float]:
    """(unit, factor): the unit a person reads this dimension in; a value in SI divided by the factor is in that unit."""
    if dimension == NONE:
        return "", 1.0
    for name in _READABLE:
        if UNITS[name].dimension == dimension:
            return name, UNITS[name].factor
    return words(dimension), 1.0


def words(dimension: Dimension) -> str:
    """The dimension in SI base units, as `kg m-1 s-2`."""
    parts = [base + (str(power) if power != 1 else "") for base, power in zip(BASES, dimension, strict=True) if power]
    return " ".join(parts) or "a plain number"
