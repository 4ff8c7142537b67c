"""`hilrunner`: names of commands and nothing else; each command's file is imported only when it is called.

Little is imported above: until `main` has begun, Ctrl-C still shows Python's own traceback.
"""

import sys

from hilrunner import __version__
from hilrunner.base import exit_codes
from hilrunner.commands.interrupt import INTERRUPTED, Interrupts

TYPE_CHECKING = False  # the one of `typing` costs 5 ms
if TYPE_CHECKING:
    import argparse

COMMANDS = {
    "run": "the main job: a firmware on CAN drives the simulated actuator (default when the first word is an option)",
    "simulate": "the plant alone: no CAN, no wall clock",
    "report": "latency report and verdict of a run",
    "sign": "a signature beside a log: whose key vouches for it",
    "verify": "a log's own checksums, and the signature beside it",
    "replay": "bit-exact surrogate replay, and the DAE beside it",
    "map": "propose a profile for a database of your own (DBC, KCD, SYM, ARXML)",
    "decode": "the CAN frames of a log as engineering values; candump and ASC files",
    "train": "sample, solve, train and export a surrogate",
    "reproduce": "the article's figures and tables beside ours: accuracy, creep, training, time, memory",
    "doctor": "is this host fit for real time? each finding with its remedy",
    "bench": "plant step, loop and log against named rivals",
    "profiles": "list the profiles that ship",
    "warm-up": "compile everything that a run of a profile needs, and keep it",
    "lab": "run a command beside a real CAN bus, on kernels without one as well",
    "check": "validate a profile: keys, units, DBC, model, stability, bus load",
}

COMPILING = ("run", "simulate", "replay", "check", "bench", "warm-up")  # the loop and its plants

EXIT_CODES = """exit codes:
  0 done, verdict passed        1 verdict failed
  2 usage or bad input          3 deadline budget exceeded
  4 CAN lost                    5 cross-check out of tolerance
  6 real-time set-up refused under --require-realtime
  7 damaged: parts of a log do not match their own checksums
  8 the bench failed: the host stalled longer than the profile allows
  (several may hold: all are told, and the code is the first of 7, 4, 8, 3, 5, 1)
  130 interrupted before there was a result (a run that has begun ends with the code of its verdict)
  141 the reader of the output has gone, as in `| head` (a run goes on and ends with the code of its verdict)"""


def build_parser(command: str) -> "argparse.ArgumentParser":
    """The parser of one command."""
    import argparse
    import importlib

    from hilrunner.commands.options import Parser

    module = importlib.import_module(f"hilrunner.commands.{command.replace('-', '_')}")
    parser = Parser(
        prog=f"hilrunner {command}",
        description=module.__doc__,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    parser.set_defaults(main=module.main)
    return parser


def overview() -> str:
    """What `hilrunner --help` prints."""
    rows = "\n".join(f"  {name:10s} {text}" for name, text in COMMANDS.items())
    return (
        f"hilrunner {__version__}: hardware-in-the-loop bench for hydraulic crane actuators\n\n"
        f"usage: hilrunner --can vcan0 [options]      the main job, same as `hilrunner run --can vcan0`\n"
        f"       hilrunner COMMAND [options]          `hilrunner COMMAND --help` for its options\n\n"
        f"commands:\n{rows}\n\n{EXIT_CODES}\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    with Interrupts(also_ignored=_command_of(words) == "run", last=argv is None) as interrupts:
        try:
            return _heard(words)
        except BaseException as error:
            # what an interrupted import raises is not always a KeyboardInterrupt
            if not interrupts.asked and not isinstance(error, KeyboardInterrupt):
                if not isinstance(error, Exception):
                    raise
                from hilrunner.commands import net

                return net.told(error, _command_of(words))
    exec("")  # an interrupt inside an earlier exec of a text would let the interpreter end by a signal, not by our code
    print("hilrunner: interrupted before there was a result; nothing is left half done", file=sys.stderr)
    return INTERRUPTED


def _heard(words: list[str]) -> int:
    """The command, and the end of one whose output cannot be written."""
    from hilrunner.commands import streams
    from hilrunner.commands.plain_streams import plain_streams

    streams.open_closed()
    try:
        with plain_streams():
            try:
                return _run_command(words)
            finally:
                streams.flush()
    except OSError as error:
        if not streams.give_up(error):
            raise
        return streams.PIPE_CLOSED if isinstance(error, BrokenPipeError) else exit_codes.BAD_INPUT


def _told_while_compiling(command: str):
    from hilrunner.commands.compile_progress import CompileProgress

    progress = CompileProgress()
    if command in COMPILING:
        from hilrunner.base.compiled_cache import cache_folder, cache_place, loop_is_compiled

        if not loop_is_compiled():
            for room in ("plant", "realtime"):
                cache_folder(room)  # refused before it is said that anything is compiled into it
            progress.announce(cache_place())
    return progress


def _command_of(words: list[str]) -> str:
    return "run" if not words or words[0].startswith("-") else words[0]


def _run_command(words: list[str]) -> int:
    from hilrunner.base.errors import HilrunnerError

    if not words or words[0] in ("-h", "--help", "help"):
        print(overview(), end="")
        return 0
    if words[0] in ("-V", "--version"):
        print(f"hilrunner {__version__}")
        return 0
    command = _command_of(words)
    words = words[words[0] == command :]
    if command not in COMMANDS:
        print(f"hilrunner: no command '{command}'; commands: {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    try:
        arguments = build_parser(command).parse_args(words)
        with _told_while_compiling(command):
            return arguments.main(arguments)
    except HilrunnerError as error:
        print(f"hilrunner {command}: {error}", file=sys.stderr)
        return error.exit_code
    except MemoryError:
        print(f"hilrunner {command}: out of memory; remedy: a shorter run or log, or fewer points", file=sys.stderr)
        return exit_codes.BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
