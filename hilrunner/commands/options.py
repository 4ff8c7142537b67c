"""Numbers on the command line, refused with option, value, limit and remedy before anything is loaded."""

import argparse
from collections.abc import Callable

LONGEST_S = 1e7  # four months: ticks and nanoseconds stay far inside 64 bits
PERIOD_US = 50, 1_000_000  # as in the profile (bench.period_us)
PRIORITY_MAX = 99  # of SCHED_FIFO
PORT_MAX = 65535


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line; the usage of some thirty options above it would hide it."""

    def error(self, message: str):
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}; see {self.prog} --help\n")


def add_stimulus_channel(parser) -> None:
    """Which channel of a CAN log the valve commands are taken from."""
    parser.add_argument(
        "--stimulus-channel",
        metavar="CH",
        help="channel of a CAN log with the commands (default: the profile's, or the only one that carries them)",
    )


def seconds(text: str) -> float:
    """A duration above 0, finite."""
    value = _read(float, text, "a number of seconds")
    if not 0.0 < value <= LONGEST_S:
        raise _refused(f"{text} s", f"above 0 to {LONGEST_S:g} s", "choose a duration in this range")
    return value


def seconds_from(low: float) -> Callable[[str], float]:
    """A duration of at least `low` seconds, finite."""

    def read(text: str) -> float:
        value = _read(float, text, "a number of seconds")
        if not low <= value <= LONGEST_S:
            raise _refused(f"{text} s", f"{low:g} to {LONGEST_S:g} s", "choose a duration in this range")
        return value

    return read


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """A whole number from `low` to `high`."""
    behind = f" {unit}" if unit else ""

    def read(text: str) -> int:
        value = _read(int, text, "a whole number")
        if not low <= value <= high:
            raise _refused(f"{text}{behind}", f"{low} to {high}{behind}", "choose a number in this range")
        return value

    return read


period_us = whole(*PERIOD_US, "us")
priority = whole(0, PRIORITY_MAX)
port = whole(0, PORT_MAX)


def core(text: str) -> int:
    """The number of a core the kernel runs on, or -1: none is asked for."""
    from hilrunner.setup.host_cpu import online
    from hilrunner.setup.host_words import HostFiles

    value = _read(int, text, "a whole number")
    there = sorted(online(HostFiles()))
    if value != -1 and value not in there:
        listed = ", ".join(map(str, there)) if len(there) <= 8 else f"{there[0]} to {there[-1]}"
        raise _refused(f"no core {text}", f"{listed}; -1: none", "choose one of these cores")
    return value


def _read(kind: type, text: str, name: str):
    try:
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not {name}; remedy: write {name}") from None


def _refused(value: str, limit: str, remedy: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"{value}; allowed: {limit}; remedy: {remedy}")
