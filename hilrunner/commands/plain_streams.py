"""Standard output and error that pass no control character on, whoever prints what: the last edge before a terminal.

What draws on the terminal itself (the live line, a progress bar) takes the stream beneath by `beneath`.
"""

import contextlib
import sys
from collections.abc import Iterator

from hilrunner.base.plain_text import plain_text


class PlainStream:
    """A text stream that writes `plain_text` of what it is given; everything else is the stream's beneath.

    A character that the stream's encoding lacks is written as an escape, too: a summary must not end in a traceback because a
    terminal knows no Greek.
    """

    def __init__(self, stream) -> None:
        self.beneath = stream

    def write(self, text: str) -> int:
        """Write; returns the characters taken, as a text stream does."""
        harmless = plain_text(text)
        try:
            self.beneath.write(harmless)
        except UnicodeEncodeError:
            encoding = self.beneath.encoding or "ascii"
            self.beneath.write(harmless.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def writelines(self, lines) -> None:
        """Write each."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str):
        return getattr(self.beneath, name)

    def __iter__(self):
        return iter(self.beneath)


def beneath(stream):
    """The stream itself, for what draws on a terminal on purpose."""
    return stream.beneath if isinstance(stream, PlainStream) else stream


@contextlib.contextmanager
def plain_streams() -> Iterator[None]:
    """Guard stdout and stderr while a command runs."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (
        one if one is None or isinstance(one, PlainStream) else PlainStream(one) for one in before
    )
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
