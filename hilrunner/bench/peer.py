"""The other end of the socketpair: a compiled stand-in for the firmware that needs no interpreter while it runs.

It sends one valid command an axis in the middle of every period and takes whatever the bench sent: one frame in, three out,
as on the bus. AF_UNIX packets carry the same `struct can_frame` as SocketCAN.
"""

import contextlib
import os
import socket
import struct
import threading
import time

import numpy as np

from hilrunner.base.compiled import entry
from hilrunner.realtime import e2e
from hilrunner.realtime.clock import make_clock, now_mono_ns, wait_until
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.socketcan import make_mailbox, receive_frames, send_frames
from hilrunner.setup.database import load_database

_SOCKET_BUFFER_BYTES = 4 << 20
_INBOX_FRAMES = 512
_DATA_AT = 8
WORD_STOP, WORD_SENT, WORD_RECEIVED = range(3)


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Loop's end and peer's end, non-blocking, with buffers for thousands of frames.

    Packets in sequence, not datagrams: those are limited to net.unix.max_dgram_qlen, 10 by default.
    """
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in pair:
        end.setblocking(False)
        # the larger of the two is granted only with rights; the smaller one is enough at these rates
        with contextlib.suppress(PermissionError):
            end.setsockopt(socket.SOL_SOCKET, 32, _SOCKET_BUFFER_BYTES)  # SO_SNDBUFFORCE
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BUFFER_BYTES)
    return pair


def command_frames(dbc_path: str, table: CommandTable, valve_percent: float) -> np.ndarray:
    """Valid Active commands of every axis for every alive counter: uint8[16, axis, 16], `struct can_frame`."""
    database = load_database(dbc_path)
    frames = np.zeros((e2e.COUNTER_MODULUS, len(table.can_id), 16), np.uint8)
    for axis, can_id in enumerate(table.can_id):
        message = database.get_message_by_frame_id(int(can_id) & 0x1FFFFFFF)
        values = {signal.name: 0 for signal in message.signals}
        values |= {"control": 2, "valve_setpoint": valve_percent}
        payload = message.encode(values, scaling=True, strict=False)
        for counter in range(e2e.COUNTER_MODULUS):
            frame = frames[counter, axis]
            frame[:] = np.frombuffer(struct.pack("<IB3x8s", int(can_id), len(payload), payload), np.uint8)
            e2e.protect_p02(frame[_DATA_AT:], len(payload), table.data_ids[axis], counter)
    return frames


@entry
def run_peer(descriptor, clock, words, start_mono_ns, period_ns, frames, inbox, outbox):
    """Send and receive until words[WORD_STOP]; between two deadlines of the loop's grid, half a period off.

    Args:
        descriptor: peer's end. clock: of its own. words: int64[3], stop in, sent and received out.
        frames: uint8[16, axis, 16]. inbox, outbox: mailboxes of its own.
    """
    axis_count = frames.shape[1]
    tick = np.int64(0)
    while words[WORD_STOP] == 0:
        wait_until(clock, start_mono_ns + tick * period_ns + period_ns // 2)
        for axis in range(axis_count):
            for byte in range(16):
                outbox.frame[axis, byte] = frames[tick % 16, axis, byte]
            outbox.size_bytes[axis] = 16
        sent = send_frames(descriptor, outbox, axis_count)
        received = receive_frames(descriptor, inbox, 0)
        words[WORD_SENT] += max(sent, 0)
        words[WORD_RECEIVED] += max(received, 0)
        behind = now_mono_ns(clock) - (start_mono_ns + tick * period_ns + period_ns // 2)
        tick += 1 + max(behind // period_ns, 0)


class Peer:
    """A thread that runs `run_peer` on a core of its own while the block lasts."""

    def __init__(self, end: socket.socket, frames: np.ndarray, cpu: int) -> None:
        self._end = end
        self._frames = frames
        self._cpu = cpu
        self._clock = make_clock(0)
        self.words = np.zeros(3, np.int64)
        self._inbox = make_mailbox(_INBOX_FRAMES)
        self._outbox = make_mailbox(frames.shape[1])
        self._thread: threading.Thread | None = None

    def drain(self) -> None:
        """Take what is left from an earlier slice."""
        with contextlib.suppress(BlockingIOError):
            while self._end.recv(128):
                pass

    def start(self, start_mono_ns: int, period_ns: int) -> None:
        """Begin on the loop's grid."""
        self.words[:] = 0
        self._thread = threading.Thread(target=self._run, args=(start_mono_ns, period_ns), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self.words[WORD_STOP] = 1
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self, start_mono_ns: int, period_ns: int) -> None:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {self._cpu})
        run_peer(
            self._end.fileno(),
            self._clock,
            self.words,
            start_mono_ns,
            period_ns,
            self._frames,
            self._inbox,
            self._outbox,
        )

    def warm(self) -> None:
        """Compile, without a frame."""
        self.words[WORD_STOP] = 1
        now = time.monotonic_ns()
        run_peer(-1, self._clock, self.words, now, 1_000_000, self._frames, self._inbox, self._outbox)
