"""What a library says through `logging` belongs into our own message, not raw onto the user's terminal."""

import contextlib
import logging
from collections.abc import Iterator


class _Collector(logging.Handler):
    def __init__(self, words: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._words = words

    def emit(self, record: logging.LogRecord) -> None:
        self._words.append(record.getMessage())


def silence() -> None:
    """Warnings that nobody collects go nowhere: without any handler, `logging` itself would print them on stderr."""
    root = logging.getLogger()
    if not root.handlers:
        root.addHandler(logging.NullHandler())


@contextlib.contextmanager
def collected(library: str) -> Iterator[list[str]]:
    """The warnings and errors of a library's loggers while the block runs; nothing of them is printed."""
    silence()
    logger, words = logging.getLogger(library), []
    handler, propagate = _Collector(words), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield words
    finally:
        logger.propagate = propagate
        logger.removeHandler(handler)
