"""Latency report and verdict of a run, from its log in any state."""

import argparse
import json
import sys
import time
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner report`."""
    parser.add_argument("log", type=Path, metavar="RUN.mcap")
    parser.add_argument("--html", type=Path, metavar="FILE", help="one self-contained page")
    parser.add_argument("--json", action="store_true", help="the report as one JSON object on stdout")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="the verdict as JUnit XML")
    parser.add_argument("--hgrm", type=Path, metavar="FOLDER", help="percentile distributions as HdrHistogram text")
    parser.add_argument(
        "--signed-by",
        type=Path,
        metavar="FILE",
        help="public key that must have signed the log (RUN.mcap.sig; extra: sign)",
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="FILE.csv",
        help="motion to track: time_s, <axis>_mm (default: the profile's wave)",
    )


def main(args: argparse.Namespace) -> int:
    """Read, print, write what was asked for; the exit code is the verdict's."""
    begin_ns = time.monotonic_ns()
    from hilrunner.commands.targets import check_folder, check_targets, write_text
    from hilrunner.evidence import report as evidence

    check_targets([args.html, args.junit], log=args.log)
    if args.hgrm:
        check_folder(args.hgrm)

    report = evidence.build_report(args.log, args.reference, signed_by=args.signed_by)
    written = []
    if args.html:
        from hilrunner.evidence.report_html import report_html

        written.append(write_text(args.html, report_html(report)))
    if args.junit:
        from hilrunner.evidence.junit import junit_xml

        suite = f"{report.facts.profile_name}.{args.log.stem}"
        properties = {"mode": report.facts.mode_label, **report.facts.provenance}
        written.append(write_text(args.junit, junit_xml(report.verdict, suite, report.latency.duration_s, properties)))
    if args.hgrm:
        for name, text in evidence.hgrm_texts(report).items():
            written.append(write_text(args.hgrm / f"{name}.hgrm", text))
    if args.json:
        print(json.dumps(evidence.as_dict(report), allow_nan=False))
    else:
        from hilrunner.evidence.report_text import report_text

        print(report_text(report))
    for path in written:
        print(f"written: {path}", file=sys.stderr)
    cost = evidence.cost_since(begin_ns).sentence(f"report of {report.latency.duration_s:.0f} s")
    print(cost, file=sys.stderr)
    return report.verdict.exit_code
