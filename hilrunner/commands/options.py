"""Numbers on the command line, refused with their limits before anything starts."""

import argparse
from collections.abc import Callable

LONGEST_S = 1e7  # four months: ticks and nanoseconds stay far inside 64 bits


def seconds(text: str) -> float:
    """A duration above 0, finite."""
    value = _read(float, text, "seconds")
    if not 0.0 < value <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} s; allowed: above 0 to {LONGEST_S:g} s")
    return value


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """A whole number from `low` to `high`."""

    def read(text: str) -> int:
        value = _read(int, text, "a whole number")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text}; allowed: {low} to {high}{' ' * bool(unit)}{unit}")
        return value

    return read


def _read(kind: type, text: str, name: str):
    try:
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not {name}") from None
