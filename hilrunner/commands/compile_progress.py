"""Tells that functions are being compiled, which one and how far: one line rewritten on a terminal, plain lines elsewhere.

All on standard error. Nothing is told of what is ready within a second, and nothing while nothing is being compiled.
"""

import sys
import threading
import time
from pathlib import Path

from hilrunner.base.compile_watch import defined_names, observers

PREFIX = "hilrunner: compiling"
QUIET_S = 1.0  # nothing is said of what takes less
LINE_INTERVAL_S = 8.0  # between plain lines
REWRITE_INTERVAL_S = 0.2
COLUMNS = 110


class CompileProgress:
    """While entered, what `base.compiled` compiles is told on a stream."""

    def __init__(self, stream=None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._all = False  # everything is to be compiled, so that it can be told how far that is
        self._done: set[str] = set()
        self._begun: list[str] = []  # compiling now, the innermost last
        self._first_s: float | None = None
        self._said = False
        self._shown = False  # a line on the terminal that is to be taken away
        self._over = False
        self._changed = threading.Condition()
        self._ticker: threading.Thread | None = None

    def __enter__(self) -> "CompileProgress":
        observers.append(self.note)
        return self

    def __exit__(self, *_) -> None:
        observers.remove(self.note)
        with self._changed:
            self._over = True
            self._changed.notify()
        if self._ticker is not None:
            self._ticker.join()
        self._clear()
        if self._said and not self._terminal and self._done:
            self._line(f"{PREFIX}: done, {len(self._done)} functions in {self._since_s():.0f} s")

    def announce(self, place: Path) -> None:
        """Say before anything heavy is imported that everything has to be compiled first."""
        self._first_s = time.monotonic()
        self._all = True
        self._said = True
        self._line(f"{PREFIX} the bench, once: a minute or two; it is kept in {place.parent}")

    def note(self, name: str, begins: bool) -> None:
        """A function is about to be compiled, or has been."""
        with self._changed:
            if self._over:
                return
            if begins:
                self._begun.append(name)
                self._first_s = time.monotonic() if self._first_s is None else self._first_s
                if self._ticker is None:
                    self._ticker = threading.Thread(target=self._tick, name="compile-progress", daemon=True)
                    self._ticker.start()
            else:
                self._done.add(name)
                if name in self._begun:
                    self._begun.remove(name)
            self._changed.notify()

    def _tick(self) -> None:
        """The thread that speaks; asleep while nothing is compiled."""
        next_line_s = self._first_s + (LINE_INTERVAL_S if self._said else QUIET_S)
        while True:
            with self._changed:
                while not self._begun and not self._over:
                    self._clear()
                    self._changed.wait()
                if self._over:
                    return
                text = self._text()
            now_s = time.monotonic()
            if self._terminal and now_s - self._first_s >= QUIET_S:
                self._rewrite(text)
            elif not self._terminal and now_s >= next_line_s:
                self._line(text)
                next_line_s = now_s + LINE_INTERVAL_S
            time.sleep(REWRITE_INTERVAL_S)

    def _text(self) -> str:
        of = f" of about {len(defined_names)}" if self._all and len(defined_names) > len(self._done) else ""
        return f"{PREFIX}: {len(self._done)}{of} functions, {self._since_s():.0f} s, now {self._begun[-1]}"

    def _since_s(self) -> float:
        return time.monotonic() - self._first_s

    def _line(self, text: str) -> None:
        self._said = True
        self._write(text + "\n")

    def _rewrite(self, text: str) -> None:
        self._shown = True
        self._write("\r" + text[:COLUMNS].ljust(COLUMNS))

    def _clear(self) -> None:
        if self._shown:
            self._shown = False
            self._write("\r" + " " * COLUMNS + "\r")

    def _write(self, text: str) -> None:
        """A stream that refuses must not end what is being compiled."""
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            self._terminal = False
