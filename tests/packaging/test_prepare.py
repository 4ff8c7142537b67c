"""What `make` says on a machine that lacks something: the exact command to type, and an exit code that is not 0."""

import importlib.util
from importlib.machinery import SourceFileLoader

import pytest

from tests.rules import tree


@pytest.fixture
def prepare():
    loader = SourceFileLoader("prepare_tool", str(tree.ROOT / "tools" / "prepare"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("prepare_tool", loader))
    loader.exec_module(module)
    return module


def test_without_root_it_says_what_to_type(prepare, monkeypatch, capsys):
    monkeypatch.setattr(prepare, "sudo", lambda: None)
    with pytest.raises(SystemExit) as stop:
        prepare.install_packages(["user-mode-linux", "can-utils"])
    assert stop.value.code == prepare.EXIT_NEEDS_ROOT
    said = capsys.readouterr().out
    assert "sudo apt-get install -y --no-install-recommends user-mode-linux can-utils" in said


def test_without_apt_it_names_the_packages(prepare, monkeypatch, capsys):
    monkeypatch.setattr(prepare, "sudo", list)
    monkeypatch.setattr(prepare, "have", lambda program: program != "apt-get")
    with pytest.raises(SystemExit) as stop:
        prepare.install_packages(["can-utils"])
    assert stop.value.code == prepare.EXIT_NEEDS_ROOT
    assert "can-utils" in capsys.readouterr().out


def test_every_missing_program_becomes_a_package(prepare, monkeypatch):
    monkeypatch.setattr(prepare, "have", lambda program: False)
    monkeypatch.setattr(prepare, "native_vcan", lambda: False)
    monkeypatch.setattr(prepare.platform, "machine", lambda: "x86_64")
    for purpose, programs in (("demo", prepare.PROGRAMS), ("test", prepare.PROGRAMS | prepare.TEST_PROGRAMS)):
        missing = prepare.needed_packages(purpose)
        assert set(programs.values()) <= set(missing)
        assert "user-mode-linux" in missing


def test_native_vcan_needs_no_user_mode_linux(prepare, monkeypatch):
    monkeypatch.setattr(prepare, "have", lambda program: False)
    monkeypatch.setattr(prepare, "native_vcan", lambda: True)
    assert "user-mode-linux" not in prepare.needed_packages("demo")


@pytest.mark.parametrize("purpose", ["demo", "test"])
def test_arm64_is_not_asked_for_a_package_it_does_not_have(prepare, monkeypatch, purpose):
    monkeypatch.setattr(prepare, "have", lambda program: False)
    monkeypatch.setattr(prepare, "native_vcan", lambda: False)
    monkeypatch.setattr(prepare.platform, "machine", lambda: "aarch64")
    missing = prepare.needed_packages(purpose)
    assert "user-mode-linux" not in missing and "gcc" in missing


def test_an_old_interpreter_looks_for_a_newer_one(prepare, monkeypatch, capsys):
    monkeypatch.setattr(prepare.sys, "version_info", (3, 9, 2))
    monkeypatch.setattr(
        prepare.shutil, "which", lambda name, **_: "/usr/bin/python3.12" if name == "python3.12" else None
    )
    assert prepare.python() == "/usr/bin/python3.12"
    monkeypatch.setattr(prepare.shutil, "which", lambda name, **_: None)
    with pytest.raises(SystemExit):
        prepare.python()
    assert "3.11 or newer is needed" in capsys.readouterr().out


def test_a_changed_lock_file_asks_for_a_new_installation(prepare, monkeypatch, tmp_path):
    for name in ("requirements.lock", "pyproject.toml", "setup.py"):
        (tmp_path / name).write_text("a==1\n")
    monkeypatch.setattr(prepare, "ROOT", tmp_path)
    before = prepare.fingerprint(["requirements.lock"])
    (tmp_path / "requirements.lock").write_text("a==2\n")
    assert prepare.fingerprint(["requirements.lock"]) != before


def test_a_second_preparation_runs_nothing(prepare, monkeypatch, tmp_path):
    """The stamp of the first one is believed as long as the files it was made from are the same."""
    monkeypatch.setattr(prepare, "VENV", tmp_path)
    ran = []
    monkeypatch.setattr(prepare, "run", lambda command, **_options: ran.append(command))
    monkeypatch.setattr(prepare, "venv_works", lambda: True)
    prepare.prepare_venv("test")
    assert len(ran) == 3  # two lock files and the project
    prepare.prepare_venv("test")
    prepare.prepare_venv("demo")
    assert len(ran) == 3
