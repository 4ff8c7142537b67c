"""Replay a run: bit-exact through the same compiled cycle, then the full model (SUNDIALS IDA) beside it."""

import argparse
import json
import sys
import time
from pathlib import Path

from hilrunner.commands import options as option_types


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner replay`."""
    parser.add_argument("log", type=Path, metavar="RUN.mcap")
    parser.add_argument("--html", type=Path, metavar="FILE", help="one self-contained page with the article's plots")
    parser.add_argument("--json", action="store_true", help="the result as one JSON object on stdout")
    parser.add_argument("--out", type=Path, metavar="FILE.mcap", help="the run with its reference beside it")
    parser.add_argument("--overwrite", action="store_true", help="let --out replace a file that exists")
    parser.add_argument(
        "--only", choices=("exact", "dae"), default="both", help="bit-exact replay, or the full model (default: both)"
    )
    parser.add_argument(
        "--duration", type=option_types.seconds, metavar="S", help="full model: only so many seconds from the start"
    )
    parser.add_argument(
        "--rtol", type=float, default=1e-11, help="full model: IDA's relative tolerance (default: %(default)g)"
    )


def main(args: argparse.Namespace) -> int:
    """Replay, print, write what was asked for; exit code 0, 1 (bits differ) or 5 (out of tolerance)."""
    begin_ns = time.monotonic_ns()
    from hilrunner.base.errors import UsageError
    from hilrunner.commands.targets import check_new_log, check_targets, whole, write_text
    from hilrunner.evidence import replay as evidence
    from hilrunner.evidence.report import cost_since

    if not 1e-13 <= args.rtol <= 1e-3:
        raise UsageError("--rtol", f"{args.rtol:g}", "1e-13 to 1e-3")
    check_targets([args.html], log=args.log)
    check_new_log(args.out, args.overwrite, log=args.log)
    options = evidence.ReplayOptions(part=args.only, duration_s=args.duration, rtol=args.rtol)
    with _ProgressBar() as progress:
        replay = evidence.build_replay(args.log, options, progress)
    written = []
    if args.html:
        from hilrunner.evidence.replay_html import replay_html

        written.append(write_text(args.html, replay_html(replay)))
    if args.out:
        from hilrunner.evidence.replay_log import write_replay

        with whole(args.out) as part:
            write_replay(part, replay)
        written.append(args.out)
    if args.json:
        print(json.dumps(evidence.as_dict(replay), allow_nan=False))
    else:
        from hilrunner.evidence.replay_text import replay_text

        print(replay_text(replay))
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    print(cost_since(begin_ns).sentence("replay, with reading and compiling,"), file=sys.stderr)
    return replay.exit_code


class _ProgressBar:
    """A progress bar on a terminal, nothing elsewhere: `with _ProgressBar() as progress: progress(what, share)`."""

    def __init__(self) -> None:
        self._bar = None
        self._tasks: dict[str, object] = {}

    def __enter__(self):
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress

            from hilrunner.commands.plain_streams import beneath

            self._bar = Progress(console=Console(file=beneath(sys.stderr)), transient=True)
            self._bar.start()
        return self._report

    def __exit__(self, *_) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _report(self, what: str, share: float) -> None:
        if self._bar is None:
            return
        if what not in self._tasks:
            self._tasks[what] = self._bar.add_task(what, total=1.0)
        self._bar.update(self._tasks[what], completed=share)
