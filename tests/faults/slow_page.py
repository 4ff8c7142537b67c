"""One page whose first touch takes as long as a test wants: userfaultfd(2), resolved by a thread that waits first.

Also without rights: UFFD_USER_MODE_ONLY serves faults of user code, which is what a loop has.
"""

import ctypes
import fcntl
import mmap
import os
import platform
import select
import struct
import threading
import time

import numpy as np

_SYSCALL = {"x86_64": 323, "aarch64": 282}[platform.machine()]
_USER_MODE_ONLY = 1
_API, _REGISTER, _ZEROPAGE = 0xC018AA3F, 0xC020AA00, 0xC020AA04  # linux/userfaultfd.h
_REGISTER_MISSING = 1
_UFFD_API = 0xAA
_MESSAGE_SIZE = 32
_POLL_MS = 20


class SlowPage:
    """Use as a context manager; `array` lives in the page, `forget()` makes its next touch last `delay_s`."""

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.faults = 0
        self._stopping = False
        self._map = mmap.mmap(-1, mmap.PAGESIZE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        self.array = np.frombuffer(self._map, np.int64)
        self.array[:] = 0
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = libc.syscall(_SYSCALL, os.O_CLOEXEC | os.O_NONBLOCK | _USER_MODE_ONLY)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "userfaultfd")
        self._address = self.array.ctypes.data
        fcntl.ioctl(self._fd, _API, struct.pack("QQQ", _UFFD_API, 0, 0))
        fcntl.ioctl(self._fd, _REGISTER, struct.pack("QQQQ", self._address, mmap.PAGESIZE, _REGISTER_MISSING, 0))
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> "SlowPage":
        self._thread.start()
        return self

    def __exit__(self, *_error) -> None:
        self._stopping = True
        self._thread.join()
        os.close(self._fd)

    def forget(self) -> None:
        """Take the page away; what it held is gone."""
        self._map.madvise(mmap.MADV_DONTNEED)

    def _serve(self) -> None:
        waiting = select.poll()
        waiting.register(self._fd, select.POLLIN)
        while not self._stopping:
            if waiting.poll(_POLL_MS):
                os.read(self._fd, _MESSAGE_SIZE)
                self.faults += 1
                time.sleep(self.delay_s)
                fcntl.ioctl(self._fd, _ZEROPAGE, struct.pack("QQQQ", self._address, mmap.PAGESIZE, 0, 0))
