"""A PREEMPT_RT kernel in an emulated PC: vcan0 and vcan1, and two CAN controllers on one bus, can0 and can1, real drivers and bit rate.

QEMU emulates a PC with two Kvaser PCI cards (SJA1000); the kernel is Debian's linux-image-rt, fetched once into our cache folder
and not installed. The machine's own files are the guest's files. Emulated in software: ten to thirty times slower than the machine,
so this shows that things work (queue, states, driver), never how fast. Needs root (the guest writes files as root).
"""

import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hilrunner.base.errors import FolderError
from hilrunner.base.own_folder import cache_base, own_folder
from hilrunner.labs.job import Job
from hilrunner.labs.words import (
    EXIT_NO_LAB,
    EXIT_TIMEOUT,
    REASON_LENGTH_MAX,
    CannotStart,
    missing_packages,
    say,
    which,
)

META_PACKAGE = "linux-image-rt-amd64"
MACHINE = "x86_64"  # the PC that is emulated runs this machine's programs
PACKAGES = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "depmod": "kmod",
    "ip": "iproute2",
}
MODULES = ("virtio_pci", "9p", "9pnet_virtio", "can-raw", "vcan", "kvaser_pci")
IF_THERE = ("can-gw", "sch-tbf", "sch-netem")
# the emulated processor is not this one: both sides find the same compiled code if both ask for none of its abilities
GENERIC_CODE = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
POLL_S = 0.1

INIT = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /mnt
/bin/busybox mount -t proc proc /proc
/bin/busybox mount -t sysfs sys /sys
/bin/busybox mount -t devtmpfs dev /dev
for port in 1 2 3; do /bin/busybox stty -F /dev/ttyS$port raw -echo; done
while read module; do /bin/busybox insmod $module || echo trouble insmod $module > /dev/ttyS3; done < /modules
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=loose host /mnt || echo trouble 9p > /dev/ttyS3
/bin/busybox mkdir -p /dev/pts /dev/shm
/bin/busybox mount -t devpts pts /dev/pts
/bin/busybox mount -t tmpfs shm /dev/shm
for place in proc sys dev; do /bin/busybox mount -o bind /$place /mnt/$place; done
/bin/busybox mount -o bind /dev/pts /mnt/dev/pts
/bin/busybox mount -o bind /dev/shm /mnt/dev/shm
/bin/busybox mount -t tmpfs run /mnt/run
/bin/busybox chroot /mnt /bin/sh {folder}/job.sh </dev/null >/dev/ttyS1 2>/dev/ttyS2
echo exit $? > /dev/ttyS3
/bin/busybox sync
/bin/busybox sleep 1
/bin/busybox poweroff -f
"""
JOB = """#!/bin/sh
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
for card in can0 can1; do
  ip link set $card type can bitrate {bitrate} && ip link set $card txqueuelen 100 up || exit 125
done
for bus in vcan0 vcan1; do
  ip link add dev $bus type vcan && ip link set $bus mtu 72 up || exit 125
done
ip link set lo up multicast on
ip route add 224.0.0.0/4 dev lo
echo "ready $(uname -r), PREEMPT_RT $(cat /sys/kernel/realtime)" > /dev/ttyS3
{environment}
cd {cwd} && exec {command}
"""


def run(job: Job) -> int:
    """Boot the emulated PC, run the command in it; returns its exit code.

    Raises:
        CannotStart: packages or rights are missing, or the guest did not come up.
    """
    if platform.machine() != MACHINE:
        raise CannotStart(
            f"the PC it emulates is {MACHINE} and cannot run programs of this machine, {platform.machine()}"
        )
    if missing := missing_packages(PACKAGES):
        raise CannotStart(f"not installed: {' '.join(missing)}", missing)
    if os.geteuid() != 0:
        raise CannotStart("it needs root, because its guest reads and writes this machine's files as root")
    image, modules = kernel()
    with tempfile.TemporaryDirectory(prefix="hilrunner_lab_") as name:
        folder = Path(name)
        write_job(folder, job)
        process = start_qemu(folder, image, make_initramfs(folder, module_order(modules)), job.memory)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda got, _frame: sys.exit(128 + got))
        try:
            return follow(folder, process, job)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            if job.console_path is not None:
                shutil.copyfile(folder / "kernel", job.console_path)


def checked(command: list[str], **options: object) -> str:
    """Run a step of the preparation; its output."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    if done.returncode:
        raise CannotStart(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()[-REASON_LENGTH_MAX:]}")
    return done.stdout


def kernel() -> tuple[Path, Path]:
    """Kernel image and module folder, fetched and unpacked once."""
    try:
        kept = own_folder(cache_base() / "labs" / "rt_kernel")
    except FolderError as error:
        raise CannotStart(str(error)) from None
    unpacked = kept / "kernel"
    images = sorted((unpacked / "boot").glob("vmlinuz-*"))
    if not images:
        name = next(
            line.split()[-1]
            for line in checked(["apt-cache", "depends", META_PACKAGE]).splitlines()
            if "Depends:" in line
        )
        say(f"fetching {name} (once)")
        checked(["apt-get", "download", "-q", name], cwd=kept)
        (archive,) = kept.glob(f"{name}_*.deb")
        checked(["dpkg", "-x", str(archive), str(unpacked)])
        archive.unlink()
        images = sorted((unpacked / "boot").glob("vmlinuz-*"))
        version = images[-1].name.removeprefix("vmlinuz-")
        checked([which("depmod"), "-b", str(unpacked), version])
    version = images[-1].name.removeprefix("vmlinuz-")
    return images[-1], unpacked / "lib" / "modules" / version


def module_order(folder: Path) -> list[Path]:
    """The modules wanted and what they need, in the order they are to be inserted."""
    needs = {}
    for line in (folder / "modules.dep").read_text().splitlines():
        name, _, rest = line.partition(":")
        needs[Path(name).stem.replace("_", "-")] = (name, rest.split())
    order: list[str] = []
    for wanted in MODULES + tuple(name for name in IF_THERE if name in needs):
        name, rest = needs[wanted.replace("_", "-")]
        order += [needed for needed in [*reversed(rest), name] if needed not in order]
    return [folder / name for name in order]


def make_initramfs(folder: Path, modules: list[Path]) -> Path:
    """A first file system: busybox, the modules, the init script."""
    tree = folder / "initramfs"
    (tree / "bin").mkdir(parents=True)
    shutil.copy(which("busybox"), tree / "bin" / "busybox")
    names = []
    for number, module in enumerate(modules):
        names.append(f"/{number:02d}-{module.name}")
        shutil.copy(module, tree / names[-1][1:])
    (tree / "modules").write_text("\n".join(names) + "\n")
    (tree / "init").write_text(INIT.format(folder=folder))
    (tree / "init").chmod(0o755)
    image = folder / "initramfs.cpio"
    listing = "\n".join(str(path.relative_to(tree)) for path in sorted(tree.rglob("*"))) + "\n"
    with open(image, "wb") as out:
        subprocess.run(
            [which("cpio"), "-o", "-H", "newc", "--quiet"], input=listing.encode(), stdout=out, cwd=tree, check=True
        )
    return image


def write_job(folder: Path, job: Job) -> None:
    """The script that runs in the guest's view of our files."""
    keep = GENERIC_CODE | {key: value for key, value in job.environment_in("qemu").items() if key.isidentifier()}
    environment = "\n".join(f"export {key}={shlex.quote(value)}" for key, value in keep.items())
    text = JOB.format(
        bitrate=job.bit_rate_bps,
        environment=environment,
        cwd=shlex.quote(os.getcwd()),
        command=shlex.join(job.command),
    )
    (folder / "job.sh").write_text(text)


def start_qemu(folder: Path, image: Path, initramfs: Path, memory: str) -> subprocess.Popen:
    """Boot; serial lines: 0 kernel, 1 output, 2 error output, 3 our line."""
    command = [
        which("qemu-system-x86_64"), "-accel", "tcg,thread=multi", "-cpu", "max", "-m", memory, "-smp", "2", "-display", "none",
        "-no-reboot", "-monitor", "none", "-kernel", str(image), "-initrd", str(initramfs),
        "-append", "console=ttyS0 quiet panic=-1",
        "-fsdev", "local,id=host,path=/,security_model=none,multidevs=remap",
        "-device", "virtio-9p-pci,fsdev=host,mount_tag=host",
        "-object", "can-bus,id=canbus0", "-device", "kvaser_pci,canbus=canbus0", "-device", "kvaser_pci,canbus=canbus0",
    ]  # fmt: skip
    for name in ("kernel", "stdout", "stderr", "reports"):
        (folder / name).write_bytes(b"")
        command += ["-serial", f"file:{folder / name}"]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)


class Follower:
    """Passes on what is appended to a file."""

    def __init__(self, path: Path) -> None:
        self.stream = open(path, "rb")  # noqa: SIM115  (closed with the lab)
        self.rest = b""

    def new(self) -> bytes:
        """Bytes since the last call."""
        return self.stream.read()

    def lines(self) -> list[str]:
        """Whole lines since the last call."""
        *whole, self.rest = (self.rest + self.new()).split(b"\n")
        return [line.decode(errors="replace").strip() for line in whole]


def follow(folder: Path, process: subprocess.Popen, job: Job) -> int:
    """Pass output on until the guest ends; the command's exit code or one of ours.

    Raises:
        CannotStart: the guest ended before the command began.
    """
    out, err, reports = (Follower(folder / name) for name in ("stdout", "stderr", "reports"))
    code, ready, trouble, started_s = None, False, "", time.monotonic()
    while True:
        ended = process.poll() is not None
        for stream, target in ((out, 1), (err, 2)):
            data = stream.new()
            while data:
                data = data[os.write(target, data) :]
        for line in reports.lines():
            word, _, rest = line.partition(" ")
            if word == "ready":
                ready = True
                if not job.quiet:
                    took_s = time.monotonic() - started_s
                    say(f"QEMU, Linux {rest}: vcan0, vcan1, can0 and can1 up after {took_s:.0f} s")
            elif word == "exit":
                code = int(rest)
            elif word == "trouble":
                trouble = rest
        if ended:
            break
        if job.limit_s is not None and time.monotonic() - started_s > job.limit_s:
            say(f"still running after {job.limit_s:g} s (--timeout): switched off")
            return EXIT_TIMEOUT
        time.sleep(POLL_S)
    if code is not None and ready:
        return code
    reason = trouble or kernel_reason(folder, process.returncode)
    if not ready:
        raise CannotStart(reason)
    say(f"the emulated PC ended under the command: {reason}; its messages: --console FILE")
    return EXIT_NO_LAB


def kernel_reason(folder: Path, exit_status: int) -> str:
    """One line out of what QEMU and the kernel said last."""
    told = [line for line in (folder / "kernel").read_text(errors="replace").splitlines() if line.strip()]
    panic = [line for line in told if "panic" in line]
    last = (panic or told[-1:] or ["without a word"])[0]
    return f"the emulated PC ended with status {exit_status}: {last}"
