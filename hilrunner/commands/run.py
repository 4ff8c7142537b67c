"""Run the bench: a firmware on CAN drives the simulated actuator in a fixed-period loop, and everything is logged."""

import argparse
import os
import time
from pathlib import Path

from hilrunner.commands import options

_BEGIN_MONO_NS = time.monotonic_ns()
os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # read when numpy is first imported: no pool of threads beside the loop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner run`."""
    bus = parser.add_argument_group("bus (names as in python-can)")
    bus.add_argument("--can", metavar="CH", help="SocketCAN channel; short for -c CH -i socketcan")
    bus.add_argument("-c", "--channel", metavar="CH", help="channel of the python-can interface")
    bus.add_argument("-i", "--interface", metavar="NAME", help="python-can interface (default: socketcan, or can.conf)")
    bus.add_argument(
        "-b",
        "--bitrate",
        type=options.whole(10_000, 8_000_000, "bit/s"),
        metavar="BIT/S",
        help="bit rate, where the interface sets it",
    )
    bus.add_argument("--fd", action="store_true", help="CAN FD frames")
    bus.add_argument(
        "--bus-option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a further argument of the python-can interface, as host=..., port=..., data_bitrate=...; repeatable",
    )
    bus.add_argument(
        "--stimulus",
        metavar="FILE",
        help="valve schedule, CAN log, or the log of a run, in place of commands from the bus",
    )
    options.add_stimulus_channel(bus)
    _add_virtual(parser)
    run = parser.add_argument_group("run")
    run.add_argument(
        "--profile", default="amc-lift", metavar="NAME|FILE", help="default: %(default)s; a log: as it ran"
    )
    run.add_argument(
        "--engine",
        choices=("surrogate", "onnx", "reference"),
        help="plant in the loop (default: the profile's, bench.engine)",
    )
    run.add_argument("--duration", type=options.seconds, metavar="S", help="default: until SIGINT or SIGTERM")
    run.add_argument("--log", type=Path, metavar="FILE.mcap", help="default: runs/<UTC>-<profile>.mcap")
    run.add_argument("--overwrite", action="store_true", help="let --log replace a file that exists")
    run.add_argument("--no-log", action="store_true", help="write no log")
    run.add_argument(
        "--sign", type=Path, metavar="KEY", help="sign the log with this ed25519 key (RUN.mcap.sig; extra: sign)"
    )
    run.add_argument(
        "--live",
        nargs="?",
        type=options.port,
        const=8765,
        metavar="PORT",
        help="Foxglove WebSocket (default port 8765)",
    )
    run.add_argument("--json", action="store_true", help="summary as one JSON object on stdout")
    timing = parser.add_argument_group("timing")
    timing.add_argument("--period-us", type=options.period_us, metavar="N", help="in place of the profile's period")
    timing.add_argument("--overrun", choices=("skip", "catch-up", "stop"), help="in place of the profile's policy")
    timing.add_argument(
        "--spin-us",
        type=options.whole(0, 10_000, "us"),
        metavar="N",
        help="sleep short of the deadline and spin the rest",
    )
    timing.add_argument("--cpu", type=options.core, default=-1, metavar="N", help="bind the loop to this core")
    timing.add_argument(
        "--priority", type=options.priority, default=80, metavar="N", help="SCHED_FIFO priority; 0: do not ask"
    )
    timing.add_argument("--require-realtime", action="store_true", help="refuse to run (exit 6) unless all is granted")


def _add_virtual(parser: argparse.ArgumentParser) -> None:
    virtual = parser.add_argument_group("virtual time (docs/virtual-time.md)")
    virtual.add_argument(
        "--virtual",
        action="store_true",
        help="run the firmware in virtual time, without CAN: hilrunner run --virtual [options] -- ./firmware -i vcan0",
    )
    virtual.add_argument("firmware", nargs="*", metavar="-- FIRMWARE", help="command line of the firmware")


def main(args: argparse.Namespace) -> int:
    """Run, print, and turn the outcome into the documented exit code."""
    if args.live is not None:
        from hilrunner.record.live_port import check_live_port

        check_live_port(args.live)
    from hilrunner.commands.run_session import execute

    return execute(args, _BEGIN_MONO_NS)
