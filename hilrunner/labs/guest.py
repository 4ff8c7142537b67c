"""Process 1 of the User-Mode Linux guest that `uml` boots: makes vcan0 and vcan1, runs one command, ends the guest.

    guest.py JOB.json

Console 1 is the command's output, 2 its error output, 3 the line to `uml` outside: we write `ready`, `trouble` and `exit`, it
writes numbers of signals for the command. When nobody is left on the other end of that line the guest ends. It is run as a
file, alone, and so imports nothing of ours.
"""

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from pathlib import Path

INTERFACES = ("vcan0", "vcan1")
MTU = 72  # CAN FD frames fit; classic frames of 16 bytes go through as well
EXIT_NO_LAB = 125
EXIT_CANNOT_RUN = 126
EXIT_NOT_FOUND = 127
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
RB_POWER_OFF = 0x4321FEDC


def pump(source: int, target: int) -> threading.Thread:
    """Copy bytes as they come until the source closes."""

    def copy() -> None:
        while chunk := os.read(source, 65536):
            while chunk:
                try:
                    chunk = chunk[os.write(target, chunk) :]
                except BrokenPipeError:  # our reader has gone: go on reading so that the guest does not block
                    chunk = b""

    thread = threading.Thread(target=copy, daemon=True)
    thread.start()
    return thread


def mount(libc: ctypes.CDLL, kind: str, target: str, options: str = "") -> None:
    """mount(2); a file system that is there already is fine."""
    os.makedirs(target, exist_ok=True)
    if libc.mount(kind.encode(), target.encode(), kind.encode(), 0, options.encode()) != 0:
        error = ctypes.get_errno()
        if error == errno.EBUSY:
            return
        raise OSError(error, f"mount {kind} on {target}: {os.strerror(error)}")


def guest_setup(libc: ctypes.CDLL, modules: list[str]) -> None:
    """File systems of the guest's own, the CAN modules, lo, vcan0 and vcan1."""
    os.environ["PATH"] = SYSTEM_PATH
    mount(libc, "proc", "/proc")
    mount(libc, "sysfs", "/sys")
    mount(libc, "tmpfs", "/run", "mode=755")
    mount(libc, "devpts", "/dev/pts", "gid=5,mode=620,ptmxmode=666")
    mount(libc, "tmpfs", "/dev/shm", "mode=1777")
    for name, target in (("fd", "/proc/self/fd"), ("stdin", "fd/0"), ("stdout", "fd/1"), ("stderr", "fd/2")):
        if not os.path.lexists(f"/dev/{name}"):
            os.symlink(target, f"/dev/{name}")
    Path("/proc/sys/kernel/hostname").write_text("vcan-lab")
    Path("/proc/sys/kernel/sched_rt_runtime_us").write_text("-1")  # one core: real-time tasks may use all of it
    steps = [["insmod", name] for name in modules] + [["ip", "link", "set", "lo", "up", "multicast", "on"]]
    steps.append(["ip", "route", "add", "224.0.0.0/4", "dev", "lo"])  # python-can's udp_multicast
    for interface in INTERFACES:
        steps.append(["ip", "link", "add", "dev", interface, "type", "vcan"])
        steps.append(["ip", "link", "set", interface, "mtu", str(MTU), "up"])
    for step in steps:
        subprocess.run(step, check=True)


def open_console(number: int, raw: bool, size: list[int] | None) -> int:
    """Open one of the guest's consoles; raw passes bytes unchanged."""
    descriptor = os.open(f"/dev/tty{number}", os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
    if raw:
        tty.setraw(descriptor)
    else:
        modes = termios.tcgetattr(descriptor)
        modes[1] &= ~termios.OPOST  # the terminal outside adds the carriage returns
        termios.tcsetattr(descriptor, termios.TCSANOW, modes)
    if size:
        fcntl.ioctl(descriptor, termios.TIOCSWINSZ, struct.pack("HHHH", size[1], size[0], 0, 0))
    return descriptor


def guest_output(number: int, size: list[int] | None) -> tuple[int, threading.Thread | None, int]:
    """Where the command writes: the console itself for a terminal, else a pipe copied to it."""
    console = open_console(number, raw=size is None, size=size)
    if size is not None:
        return console, None, console
    reader, writer = os.pipe()
    return writer, pump(reader, console), console


def guest_run(job: dict, reports: int) -> int:
    """Run the command; orders that come in are signals for its process group."""
    out, out_pump, out_console = guest_output(1, job["terminals"][0])
    err, err_pump, err_console = guest_output(2, job["terminals"][1])
    os.umask(job["umask"])
    try:
        environment = job["environment"]
        os.environ["PATH"] = environment.get("PATH", SYSTEM_PATH)
        child = subprocess.Popen(
            job["command"],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env=environment,
            cwd=job["cwd"],
            start_new_session=True,
        )
    except FileNotFoundError as error:
        os.write(reports, f"trouble {error.filename}: not found\n".encode())
        return EXIT_NOT_FOUND
    except OSError as error:
        os.write(reports, f"trouble {job['command'][0]}: {error.strerror}\n".encode())
        return EXIT_CANNOT_RUN

    def obey() -> None:
        try:
            with os.fdopen(os.dup(reports), "r") as orders:
                for line in orders:
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(child.pid, int(line))
        except OSError:  # the console hung up
            pass
        power_off()  # nobody outside is left to give orders

    threading.Thread(target=obey, daemon=True).start()
    threading.Thread(target=stay_awake, daemon=True).start()
    code = reap(child.pid)
    for writer, thread in ((out, out_pump), (err, err_pump)):
        if thread is not None:
            os.close(writer)
            thread.join(2.0)  # a left-over background process may keep the pipe open
    for console in (out_console, err_console):
        termios.tcdrain(console)
    return code


def stay_awake() -> None:
    """An idle guest on a busy host can miss that its console has input, until its next timer: here is one."""
    while True:
        time.sleep(0.5)


def reap(pid: int) -> int:
    """Wait for `pid`, burying orphans meanwhile (we are process 1); returns its exit code or 128 + signal."""
    while True:
        dead, status = os.wait()
        if dead == pid:
            code = os.waitstatus_to_exitcode(status)
            return code if code >= 0 else 128 - code


def power_off() -> None:
    """Write everything back and end the guest."""
    os.sync()
    time.sleep(0.05)  # let the consoles empty
    ctypes.CDLL(None).reboot(ctypes.c_int(RB_POWER_OFF))


def guest_main(job_path: str) -> None:
    """Process 1 of the guest; never returns."""
    libc = ctypes.CDLL(None, use_errno=True)
    code = EXIT_NO_LAB
    reports = -1
    try:
        mount(libc, "devtmpfs", "/dev")
        reports = open_console(3, raw=True, size=None)
        job = json.loads(Path(job_path).read_text())
        os.unlink(job_path)  # it holds the caller's environment
        guest_setup(libc, job["modules"])
        os.write(reports, f"ready {os.uname().release}\n".encode())
        code = guest_run(job, reports)
    except (OSError, subprocess.CalledProcessError) as error:
        os.write(2 if reports < 0 else reports, f"trouble guest: {error}\n".encode())
    finally:
        if reports >= 0:
            os.write(reports, f"exit {code}\n".encode())
        power_off()


if __name__ == "__main__":
    guest_main(sys.argv[1])
