"""Ctrl-C and SIGTERM, from a command's first import to its last word: one exception, one exit code, no traceback."""

import signal
import sys

INTERRUPTED = 130  # 128 + SIGINT, as shells have it: 0 would claim a verdict that nobody reached
_AGAIN_S = 0.05


class Interrupts:
    """While entered, SIGINT and SIGTERM raise KeyboardInterrupt in the main thread; `asked` tells that one did.

    Python drops an exception that is raised inside a destructor, a weakref's callback or a callback from C, and prints it as
    ignored. Imports and compilation are full of those, so a dropped interrupt is delivered again a moment later.

    Args:
        also_ignored: take signals that were ignored before, as scripts have it for what they start in the background.
        last: the process ends afterwards; its result is out, so the third of a second that the interpreter takes to end is left alone.
    """

    def __init__(self, also_ignored: bool = False, last: bool = False) -> None:
        self._also_ignored = also_ignored
        self._last = last
        self.asked = False
        self._before: dict[int, object] = {}
        self._number = signal.SIGINT
        self._alarm_before = None  # the handler of SIGALRM while an interrupt waits to come again

    def __enter__(self) -> "Interrupts":
        self._hook_before, sys.unraisablehook = sys.unraisablehook, self._dropped
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is signal.SIG_IGN and not self._also_ignored:
                continue
            try:
                self._before[number] = signal.signal(number, self.interrupt)
            except ValueError:  # not the main thread: its interrupts are its owner's
                break
        return self

    def __exit__(self, *_) -> None:
        if not self.asked:
            sys.unraisablehook = self._hook_before
        self._end_alarm()
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._last else handler or signal.SIG_DFL)

    def interrupt(self, number: int, _frame) -> None:
        """The handler."""
        self.asked, self._number = True, number
        raise KeyboardInterrupt

    def _dropped(self, unraisable) -> None:
        if not self.asked:
            self._hook_before(unraisable)
            return
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            return  # of an object that was interrupted while it was made or given back
        if self._alarm_before is None:
            self._alarm_before = signal.signal(signal.SIGALRM, self._again) or signal.SIG_DFL
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    def _again(self, _number: int, frame) -> None:
        """To whoever takes the signal by now: the run may have begun."""
        self._end_alarm()
        signal.getsignal(self._number)(self._number, frame)

    def _end_alarm(self) -> None:
        if self._alarm_before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._alarm_before)
            self._alarm_before = None
