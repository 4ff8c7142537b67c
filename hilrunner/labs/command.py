"""The command line of the labs: choose a bus, run the command beside it, pass its exit code on.

In this order: the interfaces that are there already; native vcan made for the time of the command (as root, else in a network
namespace of its own); User-Mode Linux, an ordinary program that is a Linux kernel with CAN; a PC emulated by QEMU with such a
kernel, slow, with can0 and can1 on emulated controllers beside vcan0 and vcan1. Each that cannot start says why in one line, and
the next is tried. The command sees the same files, folder and environment, no standard input; its output is passed on as it
comes, its exit code is ours, a signal to us is a signal to it.

exit codes of the lab itself: 124 --timeout reached, 125 no bus could be made, 126/127 command cannot be run/found
"""

import argparse
import re
from pathlib import Path

from hilrunner.labs import native, qemu, uml
from hilrunner.labs.job import Job
from hilrunner.labs.words import EXIT_NO_LAB, CannotStart, say

LABS = {"native": (native, "native vcan"), "uml": (uml, "User-Mode Linux"), "qemu": (qemu, "QEMU")}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options; everything from the first word that is none belongs to the command."""
    parser.add_argument("--lab", choices=("auto", *LABS), default="auto", help="which bus (default: auto)")
    parser.add_argument("--timeout", type=_seconds, metavar="S", help="end the command after S seconds, exit code 124")
    parser.add_argument(
        "--memory", type=_memory, default="3G", help="memory of a guest, taken as it is used (default: 3G)"
    )
    parser.add_argument(
        "--bitrate", type=_bit_rate, default=1_000_000, metavar="N", help="of QEMU's can0 and can1 (default: 1000000)"
    )
    parser.add_argument("--console", type=Path, metavar="FILE", help="keep what the guest's kernel said there")
    parser.add_argument("--quiet", action="store_true", help="no line about the lab itself where one starts")
    parser.add_argument("--namespace", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND")
    parser.set_defaults(refuse=parser.error)


def run(options: argparse.Namespace) -> int:
    """Try the labs asked for; the exit code of the command or of the lab."""
    command = options.command[options.command[:1] == ["--"] :]
    if not command:
        options.refuse("no command given")
    job = Job(
        command=command,
        limit_s=options.timeout,
        memory=options.memory,
        bit_rate_bps=options.bitrate,
        quiet=options.quiet,
        console_path=options.console,
        namespace=options.namespace,
    )
    return first_that_starts(job, list(LABS) if options.lab == "auto" else [options.lab])


def first_that_starts(job: Job, names: list[str]) -> int:
    """Run the job in the first of these labs that can."""
    reasons: list[tuple[str, CannotStart]] = []
    for name in names:
        lab, title = LABS[name]
        try:
            return lab.run(job)
        except CannotStart as reason:
            reasons.append((title, reason))
            if not job.quiet:
                say(f"no {title}: {reason}")
    if job.quiet:
        for title, reason in reasons:
            say(f"no {title}: {reason}")
    packages = next((reason.packages for title, reason in reasons if reason.packages and title != "native vcan"), [])
    if packages:
        say(f"no lab could start; one can with: sudo apt-get install --no-install-recommends {' '.join(packages)}")
    else:
        say("no lab could start; where the kernel has vcan: sudo modprobe vcan && sudo ip link add dev vcan0 type vcan")
    return EXIT_NO_LAB


def main(words: list[str]) -> int:
    """The labs without the rest of hilrunner, for an interpreter without its dependencies."""
    parser = argparse.ArgumentParser(
        prog="vcan_lab", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_arguments(parser)
    return run(parser.parse_args(words))


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text} s; allowed: more than 0 s")
    return value


def _memory(text: str) -> str:
    if not re.fullmatch(r"[1-9]\d{0,6}[kKmMgG]", text):
        raise argparse.ArgumentTypeError(f"'{text}'; allowed: a whole number and K, M or G, as in 3G")
    return text


def _bit_rate(text: str) -> int:
    if not text.isdecimal() or not 10_000 <= int(text) <= 1_000_000:
        raise argparse.ArgumentTypeError(f"'{text}'; allowed: 10000 to 1000000 bit/s")
    return int(text)
