"""Frames in and out of one file descriptor: `recvmmsg` and `sendmmsg`, one system call a direction and period.

The descriptor carries `struct can_frame` (16 bytes) or `struct canfd_frame` (72 bytes): a SocketCAN raw socket, or one end of
an AF_UNIX socketpair that a pump or a test feeds. The kernel writes through pointer tables that `make_mailbox` lays once, before
tick 0; they stay valid as long as the Mailbox lives, so nothing here is ever reallocated.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, types

from hilrunner.base.compiled import hot

FRAME_SIZE_CLASSIC = 16
FRAME_SIZE_FD = 72
RECEIVE_BATCH = 64  # frames one system call takes; a burst needs several
INTERRUPTS_MAX = 100  # calls that do not wait are hardly ever interrupted: one that always is has failed for good
CONTROL_SIZE = 64
MSG_PEEK = 0x02
MSG_DONTWAIT = 0x40
SOL_SOCKET = 1
SCM_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
NOT_COUNTED = -1

EAGAIN = 11
EINTR = 4
ENOBUFS = 105

_pointer = types.CPointer(types.int64)
_recvmmsg = types.ExternalFunction(
    "recvmmsg", types.int32(types.int32, _pointer, types.uint32, types.int32, types.voidptr)
)
_sendmmsg = types.ExternalFunction("sendmmsg", types.int32(types.int32, _pointer, types.uint32, types.int32))
_errno_location = types.ExternalFunction("__errno_location", types.CPointer(types.int32)())


class Mailbox(NamedTuple):
    """Frames of one direction, with the tables the kernel reads.

    Rows of `frame` are `struct canfd_frame`: id u32, length u8, flags u8, 2 reserved, data.
    """

    frame: np.ndarray  # (n, 72) uint8
    size_bytes: np.ndarray  # (n,) int64: received or to be sent; 16 or 72
    kernel_real_ns: np.ndarray  # (n,) int64: receive stamp, 0 where the socket gives none
    message: np.ndarray  # (n, 8) int64: struct mmsghdr
    vector: np.ndarray  # (n, 2) int64: struct iovec
    control: np.ndarray  # (n, CONTROL_SIZE) uint8
    overflow: np.ndarray  # (2,) int64: frames the kernel has dropped for want of receive buffer (SO_RXQ_OVFL): now, and before the first frame


def make_mailbox(frame_count: int) -> Mailbox:
    """Allocate a mailbox and lay its pointer tables (struct mmsghdr of the 64-bit Linux ABI)."""
    box = Mailbox(
        frame=np.zeros((frame_count, FRAME_SIZE_FD), np.uint8),
        size_bytes=np.zeros(frame_count, np.int64),
        kernel_real_ns=np.zeros(frame_count, np.int64),
        message=np.zeros((frame_count, 8), np.int64),
        vector=np.zeros((frame_count, 2), np.int64),
        control=np.zeros((frame_count, CONTROL_SIZE), np.uint8),
        overflow=np.array([0, NOT_COUNTED], np.int64),
    )
    for k in range(frame_count):
        box.vector[k] = (box.frame[k].ctypes.data, FRAME_SIZE_FD)
        box.message[k, 2] = box.vector[k].ctypes.data  # msg_iov
        box.message[k, 3] = 1  # msg_iovlen
        box.message[k, 4] = box.control[k].ctypes.data  # msg_control
        box.message[k, 5] = CONTROL_SIZE
    return box


@hot
def last_errno():
    """errno of the last failed call of this thread."""
    return np.int64(carray(_errno_location(), (1,))[0])


@hot
def receive_frames(descriptor, box, first):
    """Take all waiting frames into the places of the mailbox from `first` on; the first place left free, or -errno.

    One call of the kernel when fewer than RECEIVE_BATCH frames wait. Any error but "nothing waits" and a few interrupts (EINTR)
    means that the bus is gone.
    """
    count = np.int64(first)
    interrupts = 0
    room = box.frame.shape[0]
    while count < room:
        wanted = min(RECEIVE_BATCH, room - count)
        got = np.int64(
            _recvmmsg(np.int32(descriptor), box.message[count:].ctypes, np.uint32(wanted), np.int32(MSG_DONTWAIT), 0)
        )
        if got < 0:
            error = last_errno()
            if error == EAGAIN:
                return count
            if error == EINTR and interrupts < INTERRUPTS_MAX:
                interrupts += 1
                continue
            return -error
        for k in range(count, count + got):
            _take_message(box, k)
        count += got
        if got < wanted:
            return count
    return count


@hot
def peek_frame(descriptor, box):
    """The oldest waiting frame into the first place of the mailbox, left in the queue: 1, 0 when there is none, or -errno."""
    got = np.int64(
        _recvmmsg(np.int32(descriptor), box.message.ctypes, np.uint32(1), np.int32(MSG_DONTWAIT | MSG_PEEK), 0)
    )
    if got < 0:
        error = last_errno()
        return 0 if error == EAGAIN or error == EINTR else -error
    if got > 0:
        _take_message(box, 0)
    return got


@hot
def _take_message(box, k):
    """Size and ancillary data of message k, its header made ready for the next one."""
    box.size_bytes[k] = box.message[k, 7] & 0xFFFFFFFF
    _read_control(box, k)
    if box.overflow[1] == NOT_COUNTED:  # what was dropped before the run, while nobody had to read, is not its loss
        box.overflow[1] = box.overflow[0]
    # as make_mailbox laid it: the kernel wrote into the headers of the messages it filled and into no others
    box.message[k, 1] = 0  # msg_namelen
    box.message[k, 5] = CONTROL_SIZE
    box.message[k, 6] = 0  # msg_flags


@hot
def _read_control(box, k):
    """Receive stamp and drop count from the ancillary data of message k (struct cmsghdr: length, level, type, data)."""
    box.kernel_real_ns[k] = 0
    end = min(np.int64(box.message[k, 5]), np.int64(CONTROL_SIZE))
    words = box.control[k].view(np.int64)
    at = 0
    while at + 16 <= end:
        length = words[at // 8]
        if length < 16 or at + length > end:
            return
        level = words[at // 8 + 1] & 0xFFFFFFFF
        kind = words[at // 8 + 1] >> 32
        if level == SOL_SOCKET and kind == SCM_TIMESTAMPNS and length >= 32:
            box.kernel_real_ns[k] = words[at // 8 + 2] * 1_000_000_000 + words[at // 8 + 3]
        elif level == SOL_SOCKET and kind == SO_RXQ_OVFL and length >= 20:
            box.overflow[0] = words[at // 8 + 2] & 0xFFFFFFFF
        at += (length + 7) // 8 * 8


@hot
def send_frames(descriptor, box, count):
    """Send the first `count` frames without blocking; frames sent, or -errno when the bus is gone.

    A full transmit queue (ENOBUFS, EAGAIN) is not an error here: the caller counts what was not sent. Nor are a few interrupts
    (EINTR); any other error means that the bus is gone.
    """
    for k in range(count):
        box.vector[k, 1] = box.size_bytes[k]
        box.message[k, 0] = 0
        box.message[k, 1] = 0
        box.message[k, 5] = 0  # no ancillary data
        box.message[k, 4] = 0
        box.message[k, 6] = 0
    sent = np.int64(0)
    interrupts = 0
    while sent < count:
        got = np.int64(
            _sendmmsg(np.int32(descriptor), box.message[sent:].ctypes, np.uint32(count - sent), np.int32(MSG_DONTWAIT))
        )
        if got < 0:
            error = last_errno()
            if error == EINTR and interrupts < INTERRUPTS_MAX:
                interrupts += 1
                continue
            if error == EAGAIN or error == ENOBUFS:
                return sent
            return -error
        if got == 0:  # the kernel took none and says no reason: not sent
            return sent
        sent += got
    return sent
