"""Open a python-can bus so that whatever its backend does, raise or hang, ends in one clear error."""

import contextlib
import threading
from typing import Any

from hilrunner.base.errors import CanError, UsageError
from hilrunner.setup.bus_settings import resolved
from hilrunner.setup.library_words import collected

OPEN_LIMIT_S = 20.0  # python-can's own attempts to reach a server end after 10 s
_CLOSE_LIMIT_S = 5.0


class _Attempt:
    """One opening in a thread of its own: a backend may wait for ever for a device or a server that does not answer."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.bus: Any = None
        self.error: BaseException | None = None
        self._settings = settings
        self._given_up = False
        self._lock = threading.Lock()
        self.thread = threading.Thread(target=self._run, name="bus-open", daemon=True)

    def _run(self) -> None:
        import can

        try:
            bus = can.Bus(ignore_config=True, **self._settings)
        except BaseException as error:
            self.error = error
            return
        with self._lock:
            if not self._given_up:
                self.bus = bus
                return
        close_bus(bus)

    def give_up(self) -> None:
        """Close the bus if it opens after all."""
        with self._lock:
            self._given_up = True


def open_backend(interface: str, channel: str | None, options: dict[str, Any], limit_s: float = OPEN_LIMIT_S) -> Any:
    """The open python-can bus.

    Args:
        options: arguments of the backend beside interface and channel.

    Raises:
        UsageError: no such interface, or options that it does not take.
        CanError: whatever else keeps it from opening, in `limit_s` seconds at most.
    """
    settings = resolved(interface, channel, options)
    place = f"{interface}:{channel}"
    attempt = _Attempt(settings)
    with collected("can") as words:
        attempt.thread.start()
        try:
            attempt.thread.join(limit_s)
        except BaseException:
            attempt.give_up()
            raise
        if attempt.thread.is_alive():
            attempt.give_up()
            raise CanError(
                place, f"did not open within {limit_s:g} s", remedy="check that the device or server answers"
            )
    if attempt.error is not None:
        raise _explained(interface, place, attempt.error, words) from attempt.error
    return attempt.bus


def close_bus(bus: Any) -> None:
    """Shut a bus down: what it was for is done, so neither its errors nor its silence hold anything up."""

    def shut() -> None:
        with contextlib.suppress(Exception):
            bus.shutdown()

    thread = threading.Thread(target=shut, name="bus-close", daemon=True)
    thread.start()
    thread.join(_CLOSE_LIMIT_S)


def _explained(interface: str, place: str, error: BaseException, words: list[str]) -> Exception:
    import can

    said = str(error).strip() or type(error).__name__
    if words and words[-1] not in said:
        said = f"{said} ({words[-1]})"
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError | NameError):
        return CanError(
            place, f"the library of interface {interface} cannot be used: {said}",
            remedy=f"install the driver or the package that python-can's interface {interface} needs",
        )  # fmt: skip
    if isinstance(error, TypeError):
        return UsageError(
            place, f"interface {interface} does not take its options: {said}",
            "the arguments of that interface in python-can's documentation",
            "give what is missing with --bus-option KEY=VALUE, or under [can] options in the profile",
        )  # fmt: skip
    if not isinstance(error, OSError | can.CanError | ValueError):
        said = f"{type(error).__name__}: {said}"
    return CanError(
        place, f"cannot be opened: {said}", remedy="check the name, the driver, the rights and --bus-option"
    )
