"""vcan0 and vcan1 of the kernel that runs: those that are up, or made for the time of the command."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from hilrunner.labs.guest import INTERFACES, MTU
from hilrunner.labs.job import Job
from hilrunner.labs.words import (
    EXIT_CANNOT_RUN,
    EXIT_NOT_FOUND,
    EXIT_TIMEOUT,
    CannotStart,
    end_group,
    missing_packages,
    say,
    which,
)

PACKAGES = {"ip": "iproute2"}


def run(job: Job) -> int:
    """Run the command beside vcan0 and vcan1; returns its exit code.

    Raises:
        CannotStart: the kernel has no vcan, or we may not make one.
    """
    created: list[str] = []
    if not all(is_up(name) for name in INTERFACES):
        try:
            created = make_interfaces()
        except CannotStart:
            if not job.namespace and can_unshare():
                _again_in_a_namespace(job)
            raise
    if job.namespace:
        subprocess.run([which("ip"), "link", "set", "lo", "up"], capture_output=True)
    if not job.quiet:
        place = " in a network namespace of its own" if job.namespace else ""
        say(f"native vcan0 and vcan1{place}" + (f", {' and '.join(created)} made for this command" if created else ""))
    try:
        return _run_here(job)
    finally:
        remove_interfaces(created)


def is_up(interface: str) -> bool:
    """True if the interface exists and its flags say IFF_UP."""
    try:
        return bool(int(Path(f"/sys/class/net/{interface}/flags").read_text(), 16) & 1)
    except (OSError, ValueError):
        return False


def sudo() -> list[str]:
    """What goes before a command that needs root: sudo where it asks no password, else nothing (and it will fail)."""
    if os.geteuid() == 0 or not which("sudo"):
        return []
    return ["sudo", "-n"] if subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0 else []


def make_interfaces() -> list[str]:
    """Create the missing interfaces and set them up; the names created. Nothing stays behind when a step fails."""
    created: list[str] = []
    ip = which("ip")
    if ip is None:
        raise CannotStart("the program 'ip' is missing", missing_packages(PACKAGES))
    if which("modprobe"):
        subprocess.run([*sudo(), which("modprobe"), "vcan"], capture_output=True)
    for interface in INTERFACES:
        steps = []
        if not os.path.exists(f"/sys/class/net/{interface}"):
            steps.append(["link", "add", "dev", interface, "type", "vcan"])
            steps.append(["link", "set", interface, "mtu", str(MTU)])
        if not is_up(interface):
            steps.append(["link", "set", interface, "up"])
        for step in steps:
            done = subprocess.run([*sudo(), ip, *step], capture_output=True, text=True)
            if done.returncode:
                remove_interfaces(created)
                raise CannotStart(f"'ip {' '.join(step)}': {done.stderr.strip()}")
            if step[1] == "add":
                created.append(interface)
    return created


def remove_interfaces(created: list[str]) -> None:
    """Take away what `make_interfaces` created."""
    for interface in created:
        subprocess.run([*sudo(), which("ip"), "link", "del", interface], capture_output=True)


def can_unshare() -> bool:
    """True if a user without root may have vcan in a network namespace of its own (the module must be loaded)."""
    if os.geteuid() == 0 or which("unshare") is None or which("ip") is None:
        return False
    probe = "ip link add dev vcan0 type vcan && ip link set vcan0 up"
    return subprocess.run([which("unshare"), "-rn", "sh", "-c", probe], capture_output=True).returncode == 0


def _again_in_a_namespace(job: Job) -> None:
    """This process becomes the same lab inside a namespace; does not return."""
    again = [which("unshare"), "-rn", sys.executable, str(Path(__file__).with_name("__main__.py"))]
    again += ["--lab", "native", "--namespace"]
    again += ["--timeout", str(job.limit_s)] if job.limit_s else []
    again += ["--quiet"] if job.quiet else []
    os.execv(again[0], [*again, "--", *job.command])


def _run_here(job: Job) -> int:
    """Run the command as a process group of its own, passing our signals on."""
    name = job.command[0]
    try:
        child = subprocess.Popen(
            job.command, stdin=subprocess.DEVNULL, env=job.environment_in("native"), process_group=0
        )
    except FileNotFoundError as error:
        say(f"{error.filename}: not found")
        return EXIT_NOT_FOUND
    except OSError as error:
        say(f"{name}: {error.strerror}")
        return EXIT_CANNOT_RUN

    def forward(number: int, _frame: object) -> None:
        os.killpg(child.pid, number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, forward)
    try:
        code = child.wait(job.limit_s)
    except subprocess.TimeoutExpired:
        say(f"{name} was still running after {job.limit_s:g} s (--timeout): ended")
        end_group(child)
        return EXIT_TIMEOUT
    return code if code >= 0 else 128 - code
