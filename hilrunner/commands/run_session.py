"""`hilrunner run` behind its options: build the session, watch it, tell how it ended."""

import argparse
import contextlib
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from hilrunner.base import status
from hilrunner.base.errors import HilrunnerError, UsageError
from hilrunner.commands.again import load_again, stimulus_named
from hilrunner.commands.run_summary import finite, summarise_run
from hilrunner.commands.run_terminal import LiveLine, print_start, print_summary
from hilrunner.commands.run_verdict import exit_code_of, verdict_of_run
from hilrunner.commands.run_waiting import UnknownIds
from hilrunner.commands.sign import renew_signature
from hilrunner.commands.streams import is_terminal, spare_the_work
from hilrunner.commands.targets import claim_free_log, claim_log
from hilrunner.setup import host
from hilrunner.setup.axes import check_duration, engine_named
from hilrunner.setup.bus_settings import configured, with_words
from hilrunner.setup.database import load_database
from hilrunner.setup.profile import LoadedProfile, checked
from hilrunner.setup.session import RunOptions, Session

_LIVE_INTERVAL_S = 0.25
_LONG_S = 3.0  # after which it is told what is being waited for
_INSIST_S = 3.0  # the longest period is one second


def execute(args: argparse.Namespace, begin_mono_ns: int) -> int:
    """One run; returns the exit code."""
    loaded = _with_options(load_again(args.profile), args)
    check_duration(args.duration, loaded)
    _check_virtual(args)
    options = _options(args, loaded)
    key = _signing_key(args)
    session = _session(args, loaded, options, begin_mono_ns)
    before = _stop_on_signals(session)
    try:
        return _watched(session, args, key)
    finally:
        _set_signals(before)


@contextlib.contextmanager
def _told_when_long(text: str) -> Iterator[None]:
    """Say what is being waited for, where it takes a while: on a first start the cross-check may still compile."""
    timer = threading.Timer(_LONG_S, lambda: print(f"hilrunner: {text}", file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _session(args: argparse.Namespace, loaded: LoadedProfile, options: RunOptions, begin_mono_ns: int) -> Session:
    """The run on a bus, or in virtual time."""
    if not args.virtual:
        return Session(loaded, options, begin_mono_ns)
    from hilrunner.setup.virtual_session import VirtualSession, virtual_options

    virtual = virtual_options(loaded, args.firmware, args.channel or args.can)
    if options.log_path is None and loaded.profile.limits:
        from hilrunner.evidence.tally_process import make_tally

        return VirtualSession(loaded, options, virtual, begin_mono_ns, make_tally)
    return VirtualSession(loaded, options, virtual, begin_mono_ns)


def _check_virtual(args: argparse.Namespace) -> None:
    """Options that contradict each other are refused before anything is built."""
    if args.firmware and not args.virtual:
        raise UsageError(
            f"hilrunner run {args.firmware[0]}",
            "a program is run in virtual time only",
            remedy="add --virtual before --",
        )
    if not args.virtual:
        return
    for name in ("interface", "spin_us", "require_realtime", "bus_option"):
        if getattr(args, name):
            raise UsageError(f"--{name.replace('_', '-')}", "has no meaning in virtual time", remedy="leave it out")


def _signed(result, key) -> str:
    """What there is to tell of the log's signature; a log that is gone is told by the verdict."""
    if result.log_path is None or not result.log_path.is_file():
        return ""
    try:
        return renew_signature(result.log_path, key)
    except (HilrunnerError, OSError) as error:
        return f"not signed: {error}"


def _signing_key(args: argparse.Namespace):
    """The key of --sign, None without one; refused before anything starts."""
    if args.sign is None:
        return None
    if args.no_log:
        raise UsageError("--sign", "there is no log to sign", remedy="leave --no-log out")
    from hilrunner.evidence.signature import load_private_key

    return load_private_key(args.sign)


def _watched(session: Session, args: argparse.Namespace, key) -> int:
    """Start, watch, finish, tell; the exit code."""
    session.start()
    with spare_the_work():
        if not args.json:
            print_start(session)
    live = LiveLine(session, enabled=is_terminal(sys.stderr) and not args.json)
    unknown = UnknownIds(session.armed.bench, load_database(session.armed.dbc_path))
    while session.running(_LIVE_INTERVAL_S):
        unknown.update()
        live.tell([*session.news(), *unknown.news()])
        live.update()
    unknown.update()
    live.tell([*session.news(), *unknown.news()])
    live.close()
    # the run has ended: whoever wants to end it now gets its log and verdict all the same
    _set_signals(dict.fromkeys((signal.SIGINT, signal.SIGTERM), lambda *_: None))
    with _told_when_long("the run has ended; its cross-check is still at work, and its log is closed after it"):
        result = session.finish()
    verdict = verdict_of_run(result)
    code = exit_code_of(result, verdict)
    signed = _signed(result, key)
    summary = summarise_run(result, code) | {
        "verdict": finite(verdict),
        "broken_limits": verdict["causes"],
        "signed": signed,
        "unknown_ids": unknown.summary(),
    }
    with spare_the_work():
        if args.json:
            print(json.dumps(summary))
        else:
            print_summary(summary)
    return code


def _with_options(loaded: LoadedProfile, args: argparse.Namespace) -> LoadedProfile:
    """The profile with what the command line says in place of it; the log holds it so, beside the text as it was written."""
    asked = {"period_us": args.period_us, "overrun": args.overrun, "spin_us": args.spin_us}
    engine = status.ENGINE_NAMES[engine_named(loaded, args.engine)]
    bench = {key: value for key, value in asked.items() if value is not None} | {"engine": engine}
    can = {"bitrate": args.bitrate or loaded.profile.can.bitrate, "fd": args.fd or loaded.profile.can.fd}
    return checked(
        loaded.changed(
            bench=msgspec.structs.replace(loaded.profile.bench, **bench),
            can=msgspec.structs.replace(loaded.profile.can, **can),
        )
    )


def _options(args: argparse.Namespace, loaded: LoadedProfile) -> RunOptions:
    interface, channel = ("virtual time", args.channel or args.can or "vcan0") if args.virtual else _bus_names(args)
    stimulus = (
        stimulus_named(args.stimulus, loaded, channel=args.stimulus_channel) if args.stimulus is not None else None
    )
    if channel is None and stimulus is None:
        raise UsageError(
            "hilrunner run", "no bus and no stimulus", remedy="name a bus (--can vcan0) or a schedule (--stimulus FILE)"
        )
    log_path, log_is_new = (None, False) if args.no_log else _claimed_log(args, loaded)
    return RunOptions(
        engine=engine_named(loaded, None),
        interface=interface,
        channel=channel,
        bitrate=loaded.profile.can.bitrate,
        fd=loaded.profile.can.fd,
        bus_options=with_words(loaded.profile.can.options, args.bus_option),
        duration_s=args.duration,
        log_path=log_path,
        log_is_new=log_is_new,
        stimulus=None if stimulus is None else stimulus.commands,
        stimulus_facts=None if stimulus is None else stimulus.facts,
        live_port=args.live,
        require_realtime=args.require_realtime,
        realtime=host.RealtimeOptions(priority=args.priority, cpu=args.cpu),
    )


def _bus_names(args: argparse.Namespace) -> tuple[str, str | None]:
    """Interface and channel: options first, then python-can's own configuration (can.conf, CAN_INTERFACE, CAN_CHANNEL)."""
    channel = args.channel or args.can
    if args.can and args.channel and args.can != args.channel:
        raise UsageError("--can, -c", f"'{args.can}' and '{args.channel}' differ", remedy="name one channel")
    if args.interface:
        return args.interface, channel
    if args.can:
        return "socketcan", channel
    found = configured()
    return str(found.get("interface", "socketcan")), channel or found.get("channel")


def _claimed_log(args: argparse.Namespace, loaded: LoadedProfile) -> tuple[Path, bool]:
    """The log's path, and whether an empty file was made there for this run."""
    if args.log is not None:
        return args.log, claim_log(args.log, args.overwrite)
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    return claim_free_log(Path("runs"), f"{stamp}-{loaded.profile.name}"), True


def _stop_on_signals(session: Session) -> dict:
    """SIGINT and SIGTERM end the run after the current tick; before the first tick they end it as they end any command.

    So does one that comes when the first should have worked long ago. Sooner it is the same wish told twice: by an impatient
    hand, or by a parent that passes on what the terminal has told everybody.
    """
    before, asked_s = {}, []

    def stop(number, frame) -> None:
        if session.stop_early():
            asked_s.append(time.monotonic())
            if asked_s[-1] - asked_s[0] <= _INSIST_S:
                return
        if callable(before[number]):
            before[number](number, frame)
        else:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, stop)
    return before


def _set_signals(handlers: dict) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
