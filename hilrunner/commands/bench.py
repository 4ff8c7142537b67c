"""Plant step, loop, capacity, log and disturbances on this host, against named rivals in the same run, taken in turns on the same core.

Prints tables (or one JSON object) with the host's findings and never judges: a slow host is a fact, not an error. Exit code 0.
Rivals: numpy, onnxruntime, torch (if installed), a compiled Rosenbrock method, SUNDIALS IDA, scipy Radau, cyclictest (Debian package rt-tests).
"""

import argparse
import json

from hilrunner.base import exit_codes
from hilrunner.commands import options

PARTS = ("step", "loop", "capacity", "log", "disturb")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner bench`."""
    parser.add_argument("--only", choices=PARTS, action="append", help="this part (may be repeated; default: all)")
    parser.add_argument(
        "--rounds", type=options.whole(1, 1000), default=5, metavar="N", help="turns each rival gets (default 5)"
    )
    parser.add_argument(
        "--slice-s",
        type=options.seconds_from(0.02),
        default=4.0,
        metavar="S",
        help="length of a loop slice (default 4)",
    )
    parser.add_argument(
        "--log-s",
        type=options.seconds_from(0.02),
        default=10.0,
        metavar="S",
        help="length of the 10 kHz log run (default 10)",
    )
    parser.add_argument(
        "--profile", default="amc-lift", metavar="NAME|FILE", help="bench of the tick (default amc-lift)"
    )
    parser.add_argument(
        "--engine", choices=("surrogate", "reference", "onnx"), help="of the tick (default: the profile's)"
    )
    parser.add_argument(
        "--cpu", type=options.core, default=-1, metavar="N", help="core to measure on (default: the best there is)"
    )
    parser.add_argument(
        "--priority", type=options.priority, default=80, metavar="N", help="SCHED_FIFO priority (default 80)"
    )
    parser.add_argument(
        "--spin-us",
        type=options.whole(0, 10_000, "us"),
        default=0,
        metavar="N",
        help="spin tail (default: chosen from a first slice)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def main(arguments: argparse.Namespace) -> int:
    """Measure, print as each part is done; always PASSED unless it cannot be run at all."""
    from hilrunner.bench import results, run

    host_report, tables = run.host_part(arguments), []
    if not arguments.json:
        print(run.host_text(host_report))
    for part in arguments.only or PARTS:
        for table in run.PARTS[part](arguments):
            tables.append(table)
            if not arguments.json:
                print(results.text(table), flush=True)
    if arguments.json:
        print(
            json.dumps({"host": host_report, "tables": {table.key: table.as_dict() for table in tables}}, default=float)
        )
    return exit_codes.PASSED
