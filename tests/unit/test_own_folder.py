"""A folder that code is loaded from is ours alone, or refused with its place, the reason and a remedy; nothing is loaded before that."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilrunner.base import own_folder as module
from hilrunner.base.errors import FolderError
from hilrunner.base.own_folder import cache_base, own_folder

OTHER_USER, OTHER_GROUP = 65534, 65534  # nobody


@pytest.fixture(autouse=True)
def forget():
    yield
    own_folder.cache_clear()
    module._us.cache_clear()
    module._is_private_group.cache_clear()


@pytest.fixture
def as_others_see(monkeypatch):
    """Give a path another owner or group in the eyes of the check; chown itself needs root."""
    honest, played = os.lstat, {}

    def lstat(path, **options):
        state = honest(path, **options)
        change = played.get(os.fspath(path))
        if change is None:
            return state
        fields = list(state)
        for field, value in change.items():
            fields[field] = value
        return os.stat_result(fields)

    monkeypatch.setattr(module.os, "lstat", lstat)
    return lambda path, **change: played.update(
        {os.fspath(path): {{"uid": 4, "gid": 5}[name]: value for name, value in change.items()}}
    )


def refused(path) -> str:
    with pytest.raises(FolderError) as told:
        own_folder(path)
    text = str(told.value)
    assert str(path) in text and "HILRUNNER_CACHE" in text and "remedy" in text and "\n" not in text
    assert told.value.exit_code == 2
    return text


def test_it_is_made_with_all_above_it_for_us_alone_whatever_the_umask(tmp_path):
    before = os.umask(0)
    try:
        made = own_folder(tmp_path / "one" / "two")
    finally:
        os.umask(before)
    assert [p.stat().st_mode & 0o777 for p in (made, made.parent)] == [0o700, 0o700]
    assert own_folder(tmp_path / "one" / "two") == made


def test_one_that_others_may_write_is_refused_and_left_alone(tmp_path):
    folder = tmp_path / "cache"
    folder.mkdir()
    for mode in (0o777, 0o707, 0o1777):
        folder.chmod(mode)
        assert f"{mode:04o}" in refused(folder)
        assert folder.stat().st_mode & 0o7777 == mode


def test_one_of_somebody_else_is_refused(tmp_path, as_others_see):
    folder = tmp_path / "cache"
    folder.mkdir(0o700)
    as_others_see(folder, uid=OTHER_USER)
    assert "belongs to" in refused(folder)


def test_a_group_of_others_counts_and_a_group_of_ones_own_does_not(tmp_path, as_others_see, monkeypatch):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o770)
    as_others_see(folder, gid=OTHER_GROUP)
    assert "0770" in refused(folder)
    monkeypatch.setattr(module, "_is_private_group", lambda group_id: group_id == OTHER_GROUP)
    assert own_folder(folder).stat().st_mode & 0o777 == 0o700


def test_a_folder_above_that_others_may_write_is_refused_but_not_a_sticky_one(tmp_path):
    above = tmp_path / "shared"
    folder = above / "cache"
    folder.mkdir(parents=True)
    above.chmod(0o1777)
    own_folder(folder)
    own_folder.cache_clear()
    above.chmod(0o777)
    assert f"exchange what is in {above}" in refused(folder)


def test_a_link_of_ours_leads_on_and_a_link_of_somebody_else_does_not(tmp_path, as_others_see):
    (tmp_path / "disk").mkdir(0o700)
    link = tmp_path / "cache"
    link.symlink_to("disk")
    assert own_folder(link) == tmp_path / "disk"
    own_folder.cache_clear()
    as_others_see(link, uid=OTHER_USER)
    assert "belongs to" in refused(link)


def test_the_way_behind_a_link_is_looked_at_as_well(tmp_path):
    open_to_all = tmp_path / "open"
    (open_to_all / "disk").mkdir(parents=True, mode=0o700)
    open_to_all.chmod(0o777)
    (tmp_path / "cache").symlink_to(open_to_all / "disk")
    assert f"exchange what is in {open_to_all}" in refused(tmp_path / "cache")


@pytest.mark.parametrize("kind", ["link", "file of another", "folder others write"])
def test_what_others_may_have_left_in_a_readable_folder_is_found_once(tmp_path, kind, as_others_see):
    folder = tmp_path / "cache"
    inside = folder / "module" / "loop.nbc"
    inside.parent.mkdir(parents=True)
    folder.chmod(0o755)
    inside.write_bytes(b"")
    if kind == "link":
        inside.unlink()
        inside.symlink_to("/tmp/elsewhere")
    elif kind == "file of another":
        as_others_see(inside, uid=OTHER_USER)
    else:
        inside.parent.chmod(0o777)
    assert str(folder / "module") in refused(folder)
    assert folder.stat().st_mode & 0o777 == 0o755


def test_a_readable_folder_of_ours_is_closed(tmp_path):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o755)
    assert own_folder(folder).stat().st_mode & 0o777 == 0o700


def test_what_is_no_folder_or_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    assert "not a folder" in refused(tmp_path / "file").lower()
    assert "cannot be made" in refused(tmp_path / "file" / "below")
    assert "cannot be made" in refused(Path("/proc/none/cache"))


def test_a_command_loads_nothing_from_a_folder_that_others_can_write(tmp_path):
    """Through the command line: numba would unpickle what lies there."""
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o777)
    done = subprocess.run(
        [sys.executable, "-m", "hilrunner", "simulate", "--duration", "0.01", "--out", "log.mcap"],
        env=os.environ | {"HILRUNNER_CACHE": str(folder)}, capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert str(folder) in done.stderr and "0777" in done.stderr and "Traceback" not in done.stderr
    assert not list(folder.iterdir()) and not (tmp_path / "log.mcap").exists()


def test_the_place_of_the_cache_is_named_once(monkeypatch, tmp_path):
    monkeypatch.delenv("HILRUNNER_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_base() == tmp_path / "hilrunner"
    monkeypatch.setenv("HILRUNNER_CACHE", str(tmp_path / "named"))
    assert cache_base() == tmp_path / "named"


def test_root_of_a_lab_is_the_user_who_started_it_and_nowhere_else(monkeypatch):
    """In User-Mode Linux root has the files of the user outside; on any other kernel the variable means nothing."""
    monkeypatch.setenv(module.LAB_USER_VARIABLE, "1234")
    monkeypatch.setattr(module.os, "geteuid", lambda: 0)
    for cpuinfo, users in (("model name : UML\nmode : skas\nvendor_id : User Mode Linux\n", {0, 1234}), ("x86", {0})):
        monkeypatch.setattr(module.Path, "read_text", lambda path, text=cpuinfo: text)
        module._us.cache_clear()
        assert module._us() == users
