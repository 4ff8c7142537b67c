"""The article's Figures 5 to 11 and Tables 3 to 7 beside ours: accuracy, creep, training, time and memory, measured now.

Prints a table (or one JSON object) and writes `reproduce.html` and `reproduce.json`. Reports, and never judges: exit code 0
whatever holds; which limits hold and which do not stands in the last lines.
"""

import argparse
import json
import sys
import time
from pathlib import Path

PARTS = ("paper", "lift", "overrun", "creep", "networks", "time", "memory", "heldout")
SIZES = ("small", "full")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner reproduce`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/reproduce"),
        metavar="FOLDER",
        help="for both files (default: %(default)s)",
    )
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"these parts: {', '.join(PARTS)}")
    parser.add_argument("--quick", action="store_true", help="shorter cases, fewer points: about a minute")
    parser.add_argument(
        "--models", type=Path, metavar="FOLDER", help="models of your own under the names of those that ship"
    )
    parser.add_argument(
        "--train",
        nargs="?",
        choices=SIZES,
        const="small",
        metavar="SIZE",
        help="train the article's own form of network anew: small (default, a minute or two) or full, and Adam and L-BFGS beside it",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout in place of the tables")


def main(args: argparse.Namespace) -> int:
    """Measure, print, write; exit code 0, or 2 on bad input."""
    from hilrunner.base import exit_codes
    from hilrunner.commands.targets import check_targets, write_text

    train = _trainer(args)
    from hilrunner.reproduce.html import reproduction_html
    from hilrunner.reproduce.models import Models
    from hilrunner.reproduce.run import reproduce
    from hilrunner.reproduce.text import text

    models = Models.of(args.models)
    written = [args.out / "reproduce.json", args.out / "reproduce.html"]
    check_targets(written)  # before minutes of work
    found = reproduce(models, args.only or PARTS, args.quick, train, _say())
    data = json.dumps(found.as_dict(), allow_nan=False)
    write_text(written[0], data + "\n")
    write_text(written[1], reproduction_html(found))
    print(data if args.json else text(found))
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    return exit_codes.PASSED


def _trainer(args: argparse.Namespace):
    if args.train is None:
        return None
    from hilrunner.base.errors import UsageError

    try:
        import torch  # noqa: F401  (asked for before minutes of work, not after)
    except ImportError as error:
        raise UsageError(
            "hilrunner reproduce --train", "torch is not installed", remedy="pip install 'hilrunner[train]'"
        ) from error
    from hilrunner.reproduce.retrain import training_part

    return lambda models, quick: training_part(args.out / "trained", args.train)


def _say():
    """One line a part on a terminal's stderr, nothing elsewhere."""
    if not sys.stderr.isatty():
        return lambda text: None
    begin_s = time.monotonic()
    return lambda text: print(f"{time.monotonic() - begin_s:6.1f} s  {text}", file=sys.stderr, flush=True)
