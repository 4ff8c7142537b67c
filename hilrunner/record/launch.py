"""Start and end the recorder process from the runner's set-up. Cold code; imported by `setup`, never by `realtime`.

The ring lives in an anonymous memory file whose descriptor the recorder inherits: nothing has to be unlinked, and nothing
stays behind when both processes are killed.
"""

import json
import mmap
import os
import pickle
import subprocess
import tempfile
import time
from pathlib import Path

from hilrunner.base import ring as ring_layout
from hilrunner.base.errors import LogError
from hilrunner.record import config as recorder_config
from hilrunner.record.child import environment, module_command

READY_OPEN = 1
READY_REFUSED = 2


class RingBlock:
    """The shared memory of a ring; `fd` goes into RecorderConfig.ring_fd."""

    def __init__(self, fd: int, size_bytes: int) -> None:
        self.fd = fd
        self.size_bytes = size_bytes
        self.buffer = mmap.mmap(fd, size_bytes)

    def close(self) -> None:
        """Give the descriptor back; the memory goes when the last view of it does."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def create_ring(shape: ring_layout.RingShape) -> tuple[RingBlock, ring_layout.Ring]:
    """A new initialised ring of this shape and the block that holds it."""
    size_bytes = ring_layout.size_bytes(shape)
    fd = os.memfd_create("hilrunner-ring", os.MFD_CLOEXEC)
    try:
        os.ftruncate(fd, size_bytes)
        block = RingBlock(fd, size_bytes)
    except OSError as error:
        os.close(fd)
        raise LogError(
            "ring",
            f"{size_bytes / 1e6:.1f} MB of shared memory cannot be had: {error.strerror}",
            remedy="raise the memory or file size limit (ulimit -v, ulimit -f), or run fewer axes",
        ) from None
    ring = ring_layout.view(block.buffer, shape)
    ring_layout.initialise(ring, shape)
    return block, ring


def attach_ring(fd: int, shape: ring_layout.RingShape) -> tuple[RingBlock, ring_layout.Ring]:
    """The ring behind an inherited descriptor, contents untouched."""
    size_bytes = ring_layout.size_bytes(shape)
    if os.fstat(fd).st_size < size_bytes:
        raise LogError("ring", f"{os.fstat(fd).st_size} bytes of shared memory", limit=f"at least {size_bytes} bytes")
    block = RingBlock(fd, size_bytes)
    ring = ring_layout.view(block.buffer, shape)
    if ring_layout.word(ring, ring_layout.WORD_MAGIC) != ring_layout.MAGIC:
        raise LogError("ring", "the shared memory holds no ring of this version")
    return block, ring


def plants_file(plants: list, stimulus) -> int:
    """Descriptor of a memory file for CheckConfig.plants_fd; `start_recorder` hands it over and closes it here.

    Args:
        plants: plant.step.AxisPlant of each axis.
        stimulus: float64[axis, tick] or None.
    """
    fd = os.memfd_create("hilrunner-plants", os.MFD_CLOEXEC)
    try:
        with os.fdopen(fd, "wb", closefd=False) as file:
            pickle.dump((plants, stimulus), file)
    except BaseException:
        os.close(fd)
        raise
    return fd


class RecorderHandle:
    """The runner's end of the recorder process."""

    def __init__(self, process: subprocess.Popen, ring: ring_layout.Ring, errors) -> None:
        self.process = process
        self._ring = ring
        self._errors = errors
        self._summary: dict | None = None

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Until the log is open; LogError with the recorder's reason when it refuses, dies or takes too long."""
        deadline_s = time.monotonic() + timeout_s
        while (ready := ring_layout.word(self._ring, ring_layout.WORD_RECORDER_READY)) != READY_OPEN:
            if ready == READY_REFUSED or self.process.poll() is not None:
                summary = self.finish(timeout_s=5.0)
                place, problem, limit, remedy = summary.get("error") or ["recorder", self._died(), "", ""]
                raise LogError(place, problem, limit, remedy)
            if time.monotonic() > deadline_s:
                self.process.kill()
                raise LogError(
                    "recorder", f"not ready within {timeout_s:g} s", remedy="try again, or run with --no-log"
                )
            time.sleep(0.002)

    def poll(self) -> int | None:
        """None while the recorder lives, else its exit code."""
        return self.process.poll()

    def finish(self, timeout_s: float = 60.0) -> dict:
        """Wait for the log to be finished and return the recorder's summary (see docs/log.md).

        The caller has stored WORD_EXIT_REASON before. A recorder that died, or that has used no processor time for `timeout_s`
        (it is stopped, or its disk hangs), gives {"error": [...]} instead. One that works is waited for: on a first start its
        cross-check may still compile (recorder.CHECK_WAIT_S bounds that).
        """
        if self._summary is None:
            out = self._output_at_the_end(timeout_s)
            if out is None:
                self.process.kill()
                self.process.communicate()
                return {"error": ["recorder", f"did not finish within {timeout_s:g} s", "", ""]}
            lines = out.decode(errors="replace").strip().splitlines()
            try:
                self._summary = json.loads(lines[-1])
            except (IndexError, json.JSONDecodeError):
                self._summary = {"error": ["recorder", self._died(), "", ""]}
        return self._summary

    def _output_at_the_end(self, timeout_s: float) -> bytes | None:
        """What the recorder has said when it ended; None when it has stood still for `timeout_s`."""
        used, still_since_s = -1.0, time.monotonic()
        while True:
            try:
                return self.process.communicate(timeout=min(1.0, timeout_s))[0]
            except subprocess.TimeoutExpired:
                now = processor_s(self.process.pid)
                if now > used:
                    used, still_since_s = now, time.monotonic()
                elif time.monotonic() - still_since_s >= timeout_s:
                    return None

    def _died(self) -> str:
        self._errors.seek(0)
        words = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"ended with code {self.process.poll()}" + (f": {words[-1]}" if words else "")


def processor_s(pid: int) -> float:
    """Processor time a process has used, s (proc(5), fields 14 and 15 of stat); 0 for one that is not there."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def keep_in_memory(name: str, data: bytes) -> int:
    """The descriptor of an anonymous memory file with these bytes, for Attachment.fd; `start_recorder` closes it."""
    fd = os.memfd_create(name[:64], os.MFD_CLOEXEC)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]
    except OSError as error:
        os.close(fd)
        raise LogError(name, f"cannot be handed to the recorder: {error.strerror}") from None
    return fd


def start_recorder(config: recorder_config.RecorderConfig, ring: ring_layout.Ring) -> RecorderHandle:
    """Start the recorder in a session of its own (Ctrl-C does not reach it); `ring` is the one behind config.ring_fd."""
    errors = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as the handle)
    handed_over = [one.fd for one in config.attachments if one.fd is not None]
    handed_over += [] if config.check is None else [config.check.plants_fd]
    try:
        process = subprocess.Popen(
            module_command(config.module),
            env=environment(OPENBLAS_NUM_THREADS="1"),  # no pool of threads beside the loop
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            pass_fds=(config.ring_fd, *handed_over),
            start_new_session=True,
        )
    finally:
        for descriptor in handed_over:
            os.close(descriptor)
    try:
        process.stdin.write(recorder_config.encode(config).encode())
        process.stdin.close()
    except BrokenPipeError:
        pass  # it died; wait_ready tells why
    process.stdin = None
    return RecorderHandle(process, ring, errors)
