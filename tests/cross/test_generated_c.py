"""The C that ships: what the DBC gives, byte for byte; clean under strict flags; no heap and no writable globals."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.tools import contract, firmware_c

GENERATOR = firmware_c.FOLDER / "generate_messages.py"
CORE_SOURCES = [firmware_c.FOLDER / name for name in firmware_c.SOURCES]


def generate(*arguments):
    return subprocess.run([sys.executable, str(GENERATOR), *arguments], capture_output=True, text=True)


def test_the_committed_files_are_what_the_dbc_gives(tmp_path):
    assert generate("--check").returncode == 0
    assert generate("--out", str(tmp_path)).returncode == 0
    for name in ("actuator_messages.h", "actuator_messages.c"):
        assert (tmp_path / name).read_bytes() == (firmware_c.FOLDER / name).read_bytes()


def test_a_changed_dbc_is_noticed(tmp_path):
    changed = tmp_path / "changed.dbc"
    changed.write_text(contract.DBC.read_text().replace("[0|60000]", "[0|40000]"))
    done = generate("--check", "--dbc", str(changed))
    assert done.returncode == 1 and "not what changed.dbc gives" in done.stderr


def test_axes_that_are_not_alike_are_refused(tmp_path):
    changed = tmp_path / "changed.dbc"
    text = contract.DBC.read_text()
    at = text.index("BO_ 386 PRESSURES_2")
    changed.write_text(
        text[:at] + text[at:].replace("chamber_1_pressure_kpa : 16|16", "chamber_1_pressure_kpa : 16|15", 1)
    )
    done = generate("--dbc", str(changed), "--out", str(tmp_path))
    assert done.returncode != 0 and "PRESSURES_2: layout differs" in done.stderr


@pytest.mark.parametrize(
    "flags",
    [["-O2"], ["-O0"], ["-O2", "-DACTUATOR_REAL=float"], ["-O2", "-Wconversion", "-Wshadow", "-Wstrict-prototypes"]],
    ids=["O2", "O0", "float", "more warnings"],
)
def test_compiles_clean(tmp_path, flags):
    for source in CORE_SOURCES:
        subprocess.run(["cc", *firmware_c.STRICT, *flags, "-c", "-o", str(tmp_path / "o.o"), str(source)], check=True)


def test_no_heap_and_no_writable_globals(tmp_path):
    calls = set()
    for source in CORE_SOURCES:
        out = tmp_path / f"{source.stem}.o"
        subprocess.run(["cc", *firmware_c.STRICT, "-O2", "-c", "-o", str(out), str(source)], check=True)
        listing = subprocess.run(["nm", str(out)], capture_output=True, text=True, check=True).stdout
        for line in listing.splitlines():
            kind, name = line.split()[-2:]
            assert kind not in "bBdDC", f"{source.name}: {name} is a writable global"
            if kind == "U":
                calls.add(name)
    assert calls - {name for name in calls if name.startswith(("actuator_", "e2e_", "wave_", "_GLOBAL_OFFSET"))} <= {
        "cos", "exp", "fabs", "fmax", "fmod", "log", "pow", "sin", "sincos", "sqrt", "memset", "memcpy",
    }  # fmt: skip


def test_make_builds_the_reference_firmware(tmp_path):
    folder = tmp_path / "c"
    shutil.copytree(firmware_c.FOLDER, folder, ignore=shutil.ignore_patterns("build", "__pycache__"))
    environment = {name: value for name, value in os.environ.items() if name not in ("CFLAGS", "MAKEFLAGS")}
    subprocess.run(["make", "-s", "-C", str(folder)], check=True, env=environment)
    firmware = folder / "build" / "reference_firmware"
    assert "usage: reference_firmware" in subprocess.run([firmware, "--help"], capture_output=True, text=True).stdout
    for words in (
        ["--period-us", "5"],
        ["--axis", "9"],
        ["--nonsense"],
        ["word"],
        ["--gain", "x"],
        ["--priority", "100"],
    ):
        assert subprocess.run([firmware, *words], capture_output=True).returncode == 2, words
    missing = subprocess.run([firmware, "-i", "nocan9"], capture_output=True, text=True)
    assert missing.returncode == 4 and "nocan9" in missing.stderr
