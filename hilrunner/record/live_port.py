"""Where the live view is served, and whether it can be: asked before a run loads anything, and again by the recorder."""

import socket

from hilrunner.base.errors import UsageError

HOST = "127.0.0.1"


def check_live_port(port: int) -> None:
    """Refuse a port that somebody listens on or that is not ours to take; UsageError. Port 0 is any free one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server: a port just left is free
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise refusal(port, error.strerror) from None


def refusal(port: int, reason: str) -> UsageError:
    """What a user is told."""
    return UsageError(
        f"--live {port}",
        f"the live view cannot be served on {HOST}:{port}: {reason}",
        "a free port, 1024 to 65535",
        "choose another port or end what uses this one",
    )
