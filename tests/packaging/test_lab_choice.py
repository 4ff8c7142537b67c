"""Which lab gives the bus: each that cannot start says why in one line and the next is tried; a kernel's stack is never shown."""

import subprocess
import sys

import pytest

from hilrunner import cli
from hilrunner.labs import command, native, preload, qemu, uml, words
from hilrunner.labs.job import Job
from hilrunner.labs.words import EXIT_NO_LAB, CannotStart
from tests.rules import tree

JOB = Job(command=["true"], environment={})
# how the 6.1 kernel dies on a processor with AMX
REGISTER_STACK = """Kernel panic - not syncing: Attempted to kill init! exitcode=0x0000000b
Call Trace:
 [<606944ba>] ? _printk+0x0/0x94
 [<6002e653>] fatal_sigsegv+0x39/0x45
 [<6004b1ca>] ? put_fp_registers+0x10/0x12
 [<60048839>] userspace+0xab/0x570""".splitlines()


def cannot(reason, packages=None):
    def run(_job):
        raise CannotStart(reason, packages)

    return run


@pytest.fixture
def none_starts(monkeypatch):
    monkeypatch.setattr(native, "run", cannot("'ip link add': Operation not supported"))
    monkeypatch.setattr(uml, "run", cannot("not installed: user-mode-linux kmod", ["user-mode-linux", "kmod"]))
    monkeypatch.setattr(qemu, "run", cannot("not installed: cpio", ["cpio"]))


def test_each_says_why_in_one_line_and_what_to_type_comes_last(none_starts, capfd):
    assert command.first_that_starts(JOB, list(command.LABS)) == EXIT_NO_LAB
    assert capfd.readouterr().err.splitlines() == [
        "lab: no native vcan: 'ip link add': Operation not supported",
        "lab: no User-Mode Linux: not installed: user-mode-linux kmod",
        "lab: no QEMU: not installed: cpio",
        "lab: no lab could start; one can with: sudo apt-get install --no-install-recommends user-mode-linux kmod",
    ]


def test_quiet_says_nothing_where_one_starts_and_everything_where_none_does(none_starts, monkeypatch, capfd):
    quiet = Job(command=["true"], environment={}, quiet=True)
    assert command.first_that_starts(quiet, list(command.LABS)) == EXIT_NO_LAB
    assert len(capfd.readouterr().err.splitlines()) == 4
    monkeypatch.setattr(qemu, "run", lambda job: 7)
    assert command.first_that_starts(quiet, list(command.LABS)) == 7
    assert capfd.readouterr().err == ""


def test_the_first_that_starts_runs_the_command_and_no_other(monkeypatch):
    tried = []
    monkeypatch.setattr(native, "run", lambda job: tried.append("native") or cannot("no")(job))
    monkeypatch.setattr(uml, "run", lambda job: tried.append("uml") or 125)  # the command's own 125
    monkeypatch.setattr(qemu, "run", lambda job: tried.append("qemu") or 0)
    assert command.first_that_starts(JOB, list(command.LABS)) == 125
    assert tried == ["native", "uml"]


def test_words_of_others_become_one_line():
    text = str(CannotStart("first\n\x1b[31mred\x00 " + "long " * 100))
    assert text.isprintable() and len(text) <= words.REASON_LENGTH_MAX


def test_a_kernel_that_dies_gives_a_reason_and_no_stack():
    told = uml.kernel_reason(REGISTER_STACK, "there is no C compiler", -6)
    assert "registers" in told and "there is no C compiler" in told
    other = [line for line in REGISTER_STACK if "put_fp" not in line]
    assert uml.kernel_reason(other, "", -6).endswith(other[0])
    assert "[<" not in uml.kernel_reason(REGISTER_STACK[2:4], "", -6) + told
    assert "status -6" in uml.kernel_reason([], "", -6)


def test_without_a_compiler_the_package_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("HILRUNNER_CACHE", str(tmp_path))
    monkeypatch.setattr(preload, "which", lambda program: None)
    assert uml.preloaded(tmp_path) == ({}, "there is no C compiler")


def test_a_folder_that_others_can_write_is_not_preloaded_from(monkeypatch, tmp_path):
    (tmp_path / "labs").mkdir()
    (tmp_path / "labs").chmod(0o777)
    monkeypatch.setenv("HILRUNNER_CACHE", str(tmp_path))
    variables, why = uml.preloaded(tmp_path)
    assert variables == {} and str(tmp_path / "labs") in why and "0777" in why


@pytest.mark.parametrize("lab", [uml, qemu])
def test_a_machine_it_does_not_exist_for_is_named(monkeypatch, lab):
    monkeypatch.setattr(lab.platform, "machine", lambda: "aarch64")
    with pytest.raises(CannotStart, match="aarch64"):
        lab.run(JOB)


def test_qemu_says_what_it_lacks(monkeypatch):
    monkeypatch.setattr(qemu.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(qemu, "missing_packages", lambda packages: ["cpio"])
    with pytest.raises(CannotStart, match="not installed: cpio"):
        qemu.run(JOB)
    monkeypatch.setattr(qemu, "missing_packages", lambda packages: [])
    monkeypatch.setattr(qemu.os, "geteuid", lambda: 1000)
    with pytest.raises(CannotStart, match="root"):
        qemu.run(JOB)


def test_a_kernel_that_cannot_be_fetched_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("HILRUNNER_CACHE", str(tmp_path))
    failed = subprocess.CompletedProcess([], 100, "", "E: Unable to locate package\nE: No packages found\n")
    monkeypatch.setattr(qemu.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(CannotStart, match="Unable to locate package E: No packages found"):
        qemu.kernel()


def test_what_was_made_natively_is_taken_away_when_a_step_fails(monkeypatch):
    calls = []

    def run(words, **_options):
        calls.append(words[-5:])
        return subprocess.CompletedProcess(words, 1 if words[-1] == "up" else 0, "", "refused")

    monkeypatch.setattr(native, "which", lambda program: f"/sbin/{program}")
    monkeypatch.setattr(native, "sudo", list)
    monkeypatch.setattr(native.os.path, "exists", lambda path: False)
    monkeypatch.setattr(native.subprocess, "run", run)
    with pytest.raises(CannotStart, match="refused"):
        native.make_interfaces()
    assert calls[-1][-3:] == ["link", "del", "vcan0"]


def test_a_container_with_little_shared_memory_uses_a_file_instead(monkeypatch):
    class Small:
        f_bavail = 16384
        f_frsize = 4096

    monkeypatch.setattr(uml.os, "statvfs", lambda path: Small)
    assert not uml.fits_in_shared_memory("3G")
    assert uml.fits_in_shared_memory("32M")


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--memory", "much", "true"],
        ["--timeout", "0", "true"],
        ["--bitrate", "5", "true"],
        ["--lab", "own", "true"],
    ],
)
def test_a_command_line_that_cannot_be_carried_out_is_one_line(words, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["lab", *words])
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_tool_of_the_tree_is_the_command_of_the_package():
    """With an interpreter that has none of our dependencies."""
    done = subprocess.run(
        [sys.executable, "-I", "-S", tree.ROOT / "tools" / "vcan_lab", "--help"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "--lab {auto,native,uml,qemu}" in done.stdout
