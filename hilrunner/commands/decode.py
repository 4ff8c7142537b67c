"""The CAN frames of a log as engineering values, by the database in the log; candump and ASC files for other tools."""

import argparse
import json
import sys
from pathlib import Path

from hilrunner.commands.options import LONGEST_S, seconds_from


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner decode`."""
    parser.add_argument("log", type=Path, metavar="RUN.mcap")
    parser.add_argument(
        "--message", action="append", default=[], metavar="NAME", help="only this message; may be repeated"
    )
    parser.add_argument(
        "--from", dest="first_s", type=seconds_from(0.0), default=0.0, metavar="S", help="seconds since tick 0"
    )
    parser.add_argument("--to", dest="last_s", type=seconds_from(0.0), default=LONGEST_S, metavar="S")
    parser.add_argument("--only", choices=("received", "sent"), help="default: both")
    parser.add_argument("--dbc", type=Path, metavar="FILE", help="another database than the log's")
    parser.add_argument(
        "--candump", type=Path, metavar="FILE.log", help="write the frames as candump -L does, print nothing"
    )
    parser.add_argument(
        "--asc", type=Path, metavar="FILE.asc", help="write the frames as a Vector ASC file, print nothing"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a frame")


def main(args: argparse.Namespace) -> int:
    """Read the log, print or write its frames; 0."""
    from hilrunner.commands.targets import check_targets, write_text
    from hilrunner.evidence.decode_frames import FrameLog, Selection, as_file

    targets = [("candump", args.candump), ("asc", args.asc)]
    check_targets([path for _, path in targets], log=args.log)
    selection = Selection(args.first_s, args.last_s, tuple(args.message), args.only != "sent", args.only != "received")
    frames = FrameLog(args.log, selection, args.dbc)
    written = [write_text(path, as_file(frames.frames(), kind)) for kind, path in targets if path is not None]
    if not written:
        for frame in frames.frames():
            print(json.dumps(frame.as_dict()) if args.json else frame.line())
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    print(f"{len(frames)} frames", file=sys.stderr)
    return 0
