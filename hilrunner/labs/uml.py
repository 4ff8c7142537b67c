"""User-Mode Linux from outside: a Linux kernel with CAN that is an ordinary program is started, given one command, and watched."""

import contextlib
import glob
import json
import os
import platform
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from hilrunner.base.own_folder import LAB_USER_VARIABLE
from hilrunner.labs.guest import pump
from hilrunner.labs.job import Job
from hilrunner.labs.preload import NotBuilt, register_state_mend
from hilrunner.labs.words import EXIT_NO_LAB, EXIT_TIMEOUT, SYSTEM_PATH, CannotStart, missing_packages, say, which

GUEST = Path(__file__).with_name("guest.py")
MODULES = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan", "net/can/can-gw")
MODULES += ("net/sched/sch_tbf", "net/sched/sch_netem")  # `tc` gives vcan a rate, a queue, loss, delay
PACKAGES = {"linux.uml": "user-mode-linux", "insmod": "kmod", "ip": "iproute2"}
MACHINES = ("x86_64", "i386", "i686")  # what User-Mode Linux exists for
BOOT_LIMIT_S = 120.0
KERNEL_LINES_KEPT = 1000


def run(job: Job) -> int:
    """Boot a guest, run the command in it; returns its exit code.

    Raises:
        CannotStart: packages are missing, or the guest did not come up.
    """
    if platform.machine() not in MACHINES:
        raise CannotStart(f"it does not exist for {platform.machine()}")
    modules = module_files()
    missing = missing_packages(PACKAGES)
    if missing or not modules:
        missing = missing or ["user-mode-linux"]
        raise CannotStart(f"not installed: {' '.join(missing)}", missing)
    with tempfile.TemporaryDirectory(prefix="hilrunner_lab_") as name:
        folder = Path(name)
        _write_job(folder, job, modules)
        return _watched(Guest(folder, job), job)


def module_files() -> list[str]:
    """The CAN modules of the User-Mode Linux kernel, in the order they are to be inserted; empty if incomplete."""
    for folder in sorted(glob.glob("/usr/lib/uml/modules/*/kernel"), reverse=True):
        files = [f"{folder}/{name}.ko" for name in MODULES]
        if all(os.path.exists(name) for name in files):
            return files
    return []


def _write_job(folder: Path, job: Job, modules: list[str]) -> None:
    """What the guest's process 1 reads, and the script that is it."""
    mask = os.umask(0)
    os.umask(mask)
    environment = {"OPENBLAS_NUM_THREADS": "1"} | job.environment_in("uml")  # one core, and threads are dear in it
    environment[LAB_USER_VARIABLE] = str(os.geteuid())
    content = {
        "command": job.command,
        "cwd": os.getcwd(),
        "environment": environment,
        "umask": mask,
        "terminals": [terminal_size(1), terminal_size(2)],
        "modules": modules,
    }
    (folder / "job.json").write_text(json.dumps(content))
    words = [os.path.realpath(sys.executable), "-I", str(GUEST), f"{folder}/job.json"]
    (folder / "init").write_text(f"#!/bin/sh\nexec {shlex.join(words)}\n")
    (folder / "init").chmod(0o700)


def _watched(guest: "Guest", job: Job) -> int:
    """Pass our signals on until the command has ended; a fourth, or one before the guest is up, ends the guest."""
    interrupts = [0]

    def forward(number: int, _frame: object) -> None:
        interrupts[0] += 1
        if interrupts[0] > 3 or not guest.ready.is_set():
            guest.exit_code = 128 + number
            guest.kill()
        else:
            guest.signal(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, forward)
    try:
        return guest.wait(job.limit_s)
    finally:
        guest.kill()


def terminal_size(descriptor: int) -> list[int] | None:
    """Columns and rows if the descriptor is a terminal, else None."""
    try:
        size = os.get_terminal_size(descriptor)
    except OSError:
        return None
    return [size.columns, size.lines]


def fits_in_shared_memory(memory: str) -> bool:
    """True if /dev/shm can hold the guest's memory (containers often give 64 MB, and a full one kills the guest)."""
    factors = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30}
    size_bytes = int(memory[:-1]) * factors[memory[-1].lower()]
    try:
        space = os.statvfs("/dev/shm")
    except OSError:
        return False
    return space.f_bavail * space.f_frsize > size_bytes


def stay_on_one_core() -> None:
    """The guest's kernel and its processes take turns at every system call: across cores each turn is an interrupt."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def preloaded(folder: Path) -> tuple[dict[str, str], str]:
    """What lets the kernel start on a processor with a large register state: variables of its environment, and why there are none.

    Only the kernel, a program of this machine, gets the variable: the guest's processes get the environment of the job.
    """
    try:
        library = register_state_mend()
    except NotBuilt as reason:
        return {}, str(reason)
    link = (
        folder / "register_state.so"
    )  # the variable is a list with spaces and colons between, which our cache's name may have
    link.symlink_to(library)
    return {"LD_PRELOAD": str(link)}, ""


def start_kernel(
    folder: Path, job: Job, preload: dict[str, str], pipes: dict[str, tuple[int, int]]
) -> subprocess.Popen:
    """Start the guest: console 0 kernel messages, 1 output, 2 error output, 3 our line to the guest's init."""
    line = [which("linux.uml"), f"mem={job.memory}", "root=/dev/root", "rootfstype=hostfs", "hostfs=/", "rw", "quiet"]
    line += [f"init={folder}/init", "con=null", "ssl=null"]
    line += [f"con0=null,fd:{pipes['kernel'][1]}"]
    line += [f"con1=null,fd:{pipes['stdout'][1]}", f"con2=null,fd:{pipes['stderr'][1]}"]
    line += [f"con3=fd:{pipes['orders'][0]},fd:{pipes['reports'][1]}"]
    ours = [pipes[name][1] for name in ("kernel", "stdout", "stderr", "reports")] + [pipes["orders"][0]]
    environment = {"PATH": SYSTEM_PATH, "HOME": str(folder)} | preload  # HOME: where the guest's pid file goes
    if not fits_in_shared_memory(job.memory):
        environment["TMPDIR"] = str(folder)
    child = subprocess.Popen(
        line,
        preexec_fn=stay_on_one_core,
        stdin=subprocess.DEVNULL,
        stdout=pipes["kernel"][1],
        stderr=pipes["kernel"][1],
        pass_fds=ours,
        env=environment,
        cwd="/",
        start_new_session=True,
    )
    for end in ours:
        os.close(end)
    with contextlib.suppress(PermissionError):  # as root: one guest core against all other work of the machine
        os.setpriority(os.PRIO_PGRP, child.pid, -10)
    return child


class Guest:
    """One boot of User-Mode Linux with one command in it."""

    def __init__(self, folder: Path, job: Job) -> None:
        self.job = job
        self.exit_code: int | None = None
        self.started_s = time.monotonic()
        self.ready = threading.Event()
        self.trouble = ""
        self.kernel_lines: list[str] = []
        pipes = {name: os.pipe() for name in ("kernel", "stdout", "stderr", "orders", "reports")}
        self.orders = pipes["orders"][1]
        preload, self.not_preloaded = preloaded(folder)
        self.process = start_kernel(folder, job, preload, pipes)
        kernel = threading.Thread(target=self._collect, args=(pipes["kernel"][0],), daemon=True)
        reports = threading.Thread(target=self._follow, args=(pipes["reports"][0],), daemon=True)
        kernel.start()
        reports.start()
        self.threads = [pump(pipes["stdout"][0], 1), pump(pipes["stderr"][0], 2), kernel, reports]

    def _collect(self, source: int) -> None:
        with os.fdopen(source, "r", errors="replace") as stream:
            for line in stream:
                self.kernel_lines.append(line.rstrip())
                del self.kernel_lines[: len(self.kernel_lines) - KERNEL_LINES_KEPT]

    def _follow(self, source: int) -> None:
        """Read the reports of the guest's init: `ready`, `exit N`, `trouble TEXT`."""
        with os.fdopen(source, "r", errors="replace") as stream:
            for line in stream:
                word, _, rest = line.strip().partition(" ")
                if word == "ready":
                    self.ready.set()
                    if not self.job.quiet:
                        say(f"User-Mode Linux {rest}, vcan0 up after {time.monotonic() - self.started_s:.1f} s")
                elif word == "exit":
                    self.exit_code = int(rest)
                elif word == "trouble":
                    self.trouble = rest
                    if self.ready.is_set():
                        say(rest)

    def signal(self, number: int) -> None:
        """Send a signal to the command's process group inside."""
        try:
            os.write(self.orders, f"{number}\n".encode())
        except OSError:
            self.kill()

    def kill(self) -> None:
        """Switch the guest's power off, from outside."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            return

    def wait(self, limit_s: float | None) -> int:
        """Wait for the end of the command; returns its exit code or one of ours.

        Raises:
            CannotStart: the guest ended before the command began.
        """
        deadline_s = None if limit_s is None else time.monotonic() + limit_s
        boot_deadline_s = self.started_s + BOOT_LIMIT_S
        while self.process.poll() is None:
            now_s = time.monotonic()
            if deadline_s is not None and now_s > deadline_s:
                say(f"the command was still running after {limit_s:g} s (--timeout): the lab is switched off")
                self._end_on_timeout()
                return EXIT_TIMEOUT
            if now_s > boot_deadline_s and not self.ready.is_set():
                self.trouble = self.trouble or f"not up after {BOOT_LIMIT_S:g} s"
                break
            time.sleep(0.02)
        self.kill()
        self.process.wait()
        for thread in self.threads:
            thread.join(5.0)
        if self.job.console_path is not None:
            self.job.console_path.write_text("\n".join(self.kernel_lines) + "\n")
        return self._result()

    def _result(self) -> int:
        if self.ready.is_set() and self.exit_code is not None:
            return self.exit_code
        if self.exit_code is not None and self.exit_code > 128:  # a signal ended it before it was up
            return self.exit_code
        reason = self.trouble or kernel_reason(self.kernel_lines, self.not_preloaded, self.process.returncode)
        if not self.ready.is_set():
            raise CannotStart(reason, ["gcc"] if self.not_preloaded and which("cc") is None else None)
        say(f"User-Mode Linux ended under the command: {reason}; its messages: --console FILE")
        return EXIT_NO_LAB

    def _end_on_timeout(self) -> None:
        self.signal(signal.SIGTERM)
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.kill()
            self.process.wait()


def kernel_reason(lines: list[str], not_preloaded: str, exit_status: int) -> str:
    """One line out of a kernel's last words: what it says it died of, never its stack."""
    if any("put_fp_registers" in line for line in lines):
        why = f" and the mend for it cannot be built: {not_preloaded}" if not_preloaded else ""
        return f"its kernel cannot write back this processor's registers, a state larger than it knows{why}"
    told = [line for line in lines if line.strip() and not line.lstrip().startswith(("[<", "Call Trace", "Stack"))]
    panic = [line for line in told if "panic" in line or "BUG:" in line]
    if panic:
        return f"its kernel stopped: {panic[0]}"
    return f"it ended with status {exit_status}: {told[-1]}" if told else f"it ended with status {exit_status}, silent"
