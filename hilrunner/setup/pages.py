"""Multiplexed signals: at which numbers of which multiplexers a signal is there, and which pages a sent message takes turns in."""

from fractions import Fraction

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.setup import signal_layout
from hilrunner.setup.mapping import SignalMapping
from hilrunner.setup.signal_layout import Signal, find

Page = dict[str, frozenset[int]]  # multiplexer -> numbers at which the signal is there
PAGE_COUNT_MAX = 64


def page_of(place: str, message, signal: Signal) -> Page:
    """The multiplexers a signal hangs on, up to the message itself; empty for a plain signal."""
    page: Page = {}
    here = signal
    while here.multiplexer_ids is not None:
        parent = here.multiplexer_signal
        if parent is None or parent in page:
            raise DbcError(
                f"{place}: {message.name}.{signal.name}",
                "hangs on no multiplexer that can be found",
                remedy="correct the database",
            )
        page[parent] = frozenset(here.multiplexer_ids)
        here = find(place, message, SignalMapping(parent))
    return page


def multiplexer_row(place: str, message, name: str) -> np.ndarray:
    """The bits.SIGNAL row of a multiplexer, its numbers as they are on the wire."""
    signal = find(place, message, SignalMapping(name, scale=1.0, offset=0.0))
    return signal_layout.row(f"{place}: {message.name}.{name}", signal, Fraction(1), False)


def sent_pages(where: str, pages: list[Page]) -> list[dict[str, int]]:
    """The pages a message must take turns in so that each of `pages` is sent: multiplexer -> number; one empty page without any."""
    turns: list[dict[str, int]] = []
    for page in pages:
        if not page or any(fits(page, turn) for turn in turns):
            continue
        turns.append({name: min(numbers) for name, numbers in page.items()})
    if len(turns) > PAGE_COUNT_MAX:
        raise DbcError(where, f"{len(turns)} pages of a multiplexed message", f"{PAGE_COUNT_MAX} at most")
    # a page that another one contains need not be sent by itself
    turns = [turn for turn in turns if not any(turn != other and turn.items() < other.items() for other in turns)]
    return turns or [{}]


def fits(page: Page, turn: dict[str, int]) -> bool:
    """Whether a frame with these multiplexer numbers carries a signal of this page."""
    return all(name in turn and turn[name] in numbers for name, numbers in page.items())
