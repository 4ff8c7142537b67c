"""Standard output that cannot be written: its reader has gone (`hilrunner report run.mcap | head`), or the disk under it is full."""

import contextlib
import os
import select
import sys
from collections.abc import Iterator

PIPE_CLOSED = 141  # 128 + SIGPIPE, what a shell says of any program whose reader has gone


def open_closed() -> None:
    """Descriptors that were closed at the start (`>&-`) lead nowhere: no file of ours may be opened under their numbers."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            os.set_inheritable(number, True)
            if getattr(sys, name) is None:
                setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


def is_terminal(stream) -> bool:
    """Whether a stream is a terminal; one that is closed or not there is none."""
    try:
        return stream is not None and stream.isatty()
    except ValueError:
        return False


def flush() -> None:
    """Send what waits, so that a refusal is met here and not in the interpreter's last words."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()


def give_up(error: OSError) -> bool:
    """Write no more to the streams that refuse; False when none does, so that the error is about something else.

    A reader that has gone has seen what it wanted; any other reason is told on stderr.
    """
    refused = [stream for stream in (sys.stdout, sys.stderr) if stream is not None and _refuses(stream)]
    for stream in refused:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
    if refused and not isinstance(error, BrokenPipeError):
        print(f"hilrunner: the output cannot be written: {error.strerror}", file=sys.stderr)
    return bool(refused)


@contextlib.contextmanager
def spare_the_work() -> Iterator[None]:
    """Printing that must not end what goes on beside it: a run outlives the reader of its output."""
    try:
        yield
        flush()
    except OSError as error:
        if not give_up(error):
            raise


def _refuses(stream) -> bool:
    """Nobody reads the other end, or what waits cannot be sent (with PYTHONUNBUFFERED nothing ever waits)."""
    try:
        stream.fileno()
    except (OSError, ValueError):
        return False  # not a file at all: nothing that could refuse
    try:
        stream.flush()
        end = select.poll()
        end.register(stream.fileno(), 0)  # POLLERR is told unasked
    except OSError:
        return True
    return any(events & select.POLLERR for _, events in end.poll(0))
