"""A wheel built from the tree and installed elsewhere is a working hilrunner: commands, profiles, DBC, models, C sources."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from tests.rules import tree


def _run(command, **options):
    elsewhere = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, env=elsewhere, **options)
    assert done.returncode == 0, f"{command}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy of the project's own files, so that nothing left lying in the tree can slip in."""
    copy = tmp_path_factory.mktemp("source")
    for path in tree.project_files():
        target = copy / path.relative_to(tree.ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, target)
    out = tmp_path_factory.mktemp("wheel")
    _run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", out, copy])
    (built,) = out.glob("hilrunner-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A clean environment with the wheel; the dependencies are those of this one, by a path file, not downloaded again."""
    folder = tmp_path_factory.mktemp("elsewhere")
    _run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"])
    python = folder / "venv" / "bin" / "python"
    purelib = Path(_run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]).strip())
    (purelib / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    _run([sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index", wheel])
    return folder, python


def _names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_the_wheel_carries_every_shipped_file(wheel):
    names = _names(wheel)
    for folder in ("profiles", "firmware_iface"):
        suffixes = (".toml", ".csv", ".json", ".xml", ".onnx", ".dbc", ".c", ".h", ".md")
        for path in tree.project_files():
            if tree.relative(path).startswith(folder + "/") and path.suffix in suffixes:
                assert f"hilrunner/_data/{tree.relative(path)}" in names
    assert any(name.endswith("actuator.dbc") for name in names)


def test_the_wheel_carries_nothing_else(wheel):
    tops = {name.split("/")[0] for name in _names(wheel)}
    assert {top for top in tops if not top.startswith("hilrunner")} == set()
    assert not [name for name in _names(wheel) if name.endswith((".o", ".so", ".pyc", "reference_firmware"))]


def test_the_wheel_carries_what_error_messages_name(installed):
    """The limits file, the unit and the device rules; the remedy names the very file."""
    folder, python = installed
    program = "from hilrunner.setup import host_rights, resources; print(host_rights._RIGHTS_REMEDY.split()[1]); print(resources.host_files_folder())"
    limits, place = map(Path, _run([python, "-c", program], cwd=folder).split())
    assert limits.is_file() and limits.parent == place and folder in place.parents
    ours = {path.name: path.read_bytes() for path in (tree.ROOT / "tools" / "systemd").iterdir()}
    assert {path.name: path.read_bytes() for path in place.iterdir() if path.is_file()} == ours


def test_the_installed_lab_gives_a_bus(installed):
    assert "vcan0" in _hilrunner(installed, "lab", "--quiet", "--", "ip", "-br", "link", "show", "vcan0")


def _hilrunner(installed, *words):
    folder, python = installed
    return _run([python.parent / "hilrunner", *words], cwd=folder)


def test_the_installed_package_is_the_wheel_and_finds_its_files(installed):
    folder, python = installed
    program = (
        "import hilrunner; from hilrunner.setup import resources as r; "
        "print(hilrunner.__file__, r.profiles_folder(), r.models_folder(), r.firmware_interface_folder(), sep='\\n')"
    )
    places = _run([python, "-c", program], cwd=folder).split()
    assert all(place.startswith(str(folder)) for place in places)
    assert (Path(places[3]) / "actuator.dbc").is_file()
    assert sorted(Path(places[2]).glob("*.onnx")), "no trained model in the wheel"


def test_installed_commands_run(installed):
    assert "usage: hilrunner" in _hilrunner(installed, "--help")
    assert "amc-lift" in _hilrunner(installed, "profiles")


@pytest.mark.parametrize("name", sorted(p.stem for p in (tree.ROOT / "profiles").glob("*.toml")))
def test_installed_profiles_pass_the_check(installed, name):
    _hilrunner(installed, "check", name)
