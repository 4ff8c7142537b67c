"""Is this host fit for real time? Looks, asks for every right, tries wake-ups with them, and names the remedy of each finding.

Exit code 0: a run here would be called "real-time verified", so --require-realtime would be accepted.
Exit code 6: it would be "best effort"; the reasons are listed. 2: bad usage or profile.
"""

import argparse
import json
import os
import sys

from hilrunner.base import exit_codes
from hilrunner.base.plain_text import plain_line
from hilrunner.commands import options as option_types
from hilrunner.commands.plain_streams import beneath

_COLOURS = {"ok": "32", "warn": "33", "fail": "31", "got": "32", "refused": "31"}
_NAME_WIDTH = 27


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner doctor`."""
    parser.add_argument("--can", "-c", "--channel", dest="channel", metavar="CH", help="CAN interface to look at")
    parser.add_argument("--profile", metavar="NAME|FILE", help="take period and bus load from this profile")
    parser.add_argument(
        "--period-us",
        type=option_types.period_us,
        metavar="N",
        help="period the wake-ups are judged by (default 1000)",
    )
    parser.add_argument(
        "--cpu", type=option_types.core, default=-1, metavar="N", help="core of the loop (default: the best there is)"
    )
    parser.add_argument(
        "--priority",
        type=option_types.priority,
        default=80,
        metavar="N",
        help="SCHED_FIFO priority to try (default 80)",
    )
    parser.add_argument(
        "--seconds", type=option_types.seconds, default=1.0, metavar="S", help="duration of each try (default 1)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def main(arguments: argparse.Namespace) -> int:
    """Inspect, ask, try, give back, print; exit code PASSED or REALTIME_REFUSED."""
    from hilrunner.setup import host

    traffic, bitrate, period_ns = _from_profile(arguments)
    options = host.RealtimeOptions(priority=arguments.priority, cpu=_core(arguments.cpu))
    grants = host.enter_realtime(options)
    try:
        report = host.inspect_host(
            arguments.channel,
            cpu=options.cpu,
            period_ns=period_ns,
            traffic=traffic,
            bitrate=bitrate,
            probe_s=max(0.05, arguments.seconds),
            disturb=True,
        )
    finally:
        host.leave_realtime(grants)
    reasons = host.mode_reasons(grants, report.findings)
    label = host.mode_label(grants, report.findings)
    if arguments.json:
        words = {"ready": not reasons, "label": label, "reasons": reasons}
        print(json.dumps({**words, "grants": [grant.as_dict() for grant in grants], **report.as_dict()}, indent=2))
    else:
        print(_text(grants, report, label, reasons, _colourful()), file=beneath(sys.stdout))
    return exit_codes.REALTIME_REFUSED if reasons else exit_codes.PASSED


def _core(asked: int) -> int:
    from hilrunner.setup.host_cpu import suggest_cpu
    from hilrunner.setup.host_words import HostFiles

    return asked if asked >= 0 else suggest_cpu(HostFiles(), os.sched_getaffinity(0))


def _from_profile(arguments: argparse.Namespace) -> tuple[list, int, int]:
    """Frames on the bus, bit rate and period of the profile, or none and the period asked for."""
    period_ns = (arguments.period_us or 1000) * 1000
    if arguments.profile is None:
        return [], 0, period_ns
    from hilrunner.setup.profile import load_profile
    from hilrunner.setup.traffic import profile_traffic

    loaded = load_profile(arguments.profile)
    if arguments.period_us is None:
        period_ns = loaded.profile.bench.period_us * 1000
    return profile_traffic(loaded, period_ns), loaded.profile.can.bitrate, period_ns


def _colourful() -> bool:
    return sys.stdout.isatty() and "NO_COLOR" not in os.environ


def _line(mark: str, name: str, value: str, remedy: str, colour: bool) -> list[str]:
    shown = f"\x1b[{_COLOURS[mark]}m{mark:<8}\x1b[0m" if colour else f"{mark:<8}"
    lines = [f"{shown}{plain_line(name):<{_NAME_WIDTH}} {plain_line(value)}"]
    if remedy:
        lines.append(f"{'':8}{'':<{_NAME_WIDTH}} -> {plain_line(remedy)}")
    return lines


def _text(grants: list, report, label: str, reasons: list[str], colour: bool) -> str:
    facts = report.facts
    lines = [
        f"{facts['processor']}, {facts['cores']} cores, {facts['memory']}; Linux {facts['kernel']} {facts['machine']}",
        f"python {facts['python']}, numpy {facts['numpy']}, numba {facts['numba']}",
        "",
        "asked of the kernel",
    ]
    for grant in grants:
        value = grant.got if grant.granted else f"{grant.asked}: {grant.reason or grant.got}"
        lines += _line("got" if grant.granted else "refused", grant.name, value, grant.remedy, colour)
    lines += ["", "found"]
    for finding in report.findings:
        lines += _line(finding.verdict, finding.name, finding.value, finding.remedy, colour)
    lines += ["", f"a run here is: {label}"]
    lines += [f"  because of {reason}" for reason in reasons]
    return "\n".join(lines)
