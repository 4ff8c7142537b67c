"""Profiles: what ships is sound; what is wrong is refused with the place, the value, the limit and the remedy."""

import json

import pytest

from hilrunner import cli
from hilrunner.base.errors import ProfileError
from hilrunner.setup.profile import available_profiles, load_profile, parse_profile

GOOD = """
name = "x"
[bench]
period_us = 1000
[[axis]]
name = "luffing"
"""


def test_every_shipped_profile_loads_and_is_named_like_its_file():
    names = available_profiles()
    assert {"amc-lift", "amc-lift-heavy", "paper", "paper-table1", "overrunning", "wave-hs05"} <= set(names)
    for name in names:
        assert load_profile(name).profile.name == name


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("period_us = 1000", "period_ms = 1"), ["bench", "period_ms", "period_us"]),
        (("period_us = 1000", "period_us = 10"), ["bench.period_us", "10", "50"]),
        (("period_us = 1000", "period_us = 1.5"), ["bench.period_us", "float"]),
        (("period_us = 1000", 'overrun = "drop"'), ["bench.overrun", "drop"]),
        (('name = "luffing"', 'name = "Luffing!"'), ["axis", "name"]),
        (('name = "luffing"', 'name = "luffing"\ncircut = "lift"'), ["circut", "circuit"]),
        (('name = "luffing"', 'name = "luffing"\ninitial_position_m = 0.6'), ["initial_position_mm"]),
        (('name = "luffing"', 'name = "luffing"\n[[axis]]\nname = "luffing"'), ["axis", "share a name"]),
        (('name = "luffing"', 'name = "luffing"\n[axis.load]\nkind = "constant"'), ["force_kn"]),
        (
            ('name = "luffing"', 'name = "luffing"\n[axis.load]\nkind = "table"\nposition_mm = [0.0, 5.0]'),
            ["position_mm", "2 positions and 0 forces"],
        ),
        (('name = "luffing"', 'name = "luffing"\n[axis.command]\nstale_after_ms = 0.5'), ["stale_after_ms", "1.0 ms"]),
        (('name = "luffing"', 'name = "luffing"\n[limits]\nmisses = 3'), ["limits.misses", "deadline_misses_max"]),
        (
            ('name = "luffing"', 'name = "luffing"\n[[fault]]\nkind = "valve-stuck"\naxis = "boom"\nat_s = 1.0'),
            ["fault[0].axis", "boom", "luffing"],
        ),
        (
            ('name = "luffing"', 'name = "luffing"\n[[fault]]\nkind = "valve-stuck"\naxis = "luffing"'),
            ["fault[0]", "at_s", "when"],
        ),
        (('name = "luffing"', 'name = "luffing"\ncircuit = "lfit"'), ["axis", "'lfit'", "lift-lines"]),
        (("period_us = 1000", 'overrun = "drop"'), ["catch-up"]),
        (('name = "luffing"', 'name = "luffing"\n[axis.command]\nhold_for_ms = inf'), ["hold_for_ms", "3600000"]),
        (('name = "luffing"', 'name = "luffing"\n[axis.command]\nramp_for_ms = 1e300'), ["ramp_for_ms", "3600000"]),
        (('name = "luffing"', 'name = "luffing"\n[axis.load]\nforce_kn = 5.0'), ["load.force_kn", "knuckle-boom"]),
        (
            ('name = "luffing"', 'name = "luffing"\n[axis.load]\nkind = "constant"\nforce_kn = nan'),
            ["axis[0].load.force_kn", "nan"],
        ),
        (
            (
                'name = "luffing"',
                'name = "luffing"\n[[fault]]\nkind = "valve-stuck"\naxis = "luffing"\nat_s = 1\nvalue = nan',
            ),
            ["fault[0].value", "nan"],
        ),
        (
            ('name = "luffing"', 'name = "luffing"\n[[fault]]\nkind = "valve-stuck"\naxis = "luffing"\nat_s = 1e300'),
            ["at_s", "10000000"],
        ),
        (('name = "x"', 'name = "x'), ["not TOML"]),
        (('name = "x"', ""), ["'name' is missing", "add it"]),
    ],
)
def test_bad_input_names_place_value_and_remedy(change, words):
    with pytest.raises(ProfileError) as caught:
        parse_profile(GOOD.replace(*change), "my.toml")
    text = str(caught.value)
    assert text.startswith("my.toml")
    for word in words:
        assert word in text, text
    assert caught.value.exit_code == 2


def test_a_profile_that_is_not_there(tmp_path):
    with pytest.raises(ProfileError, match="did you mean 'amc-lift'"):
        load_profile("amc-lft")
    with pytest.raises(ProfileError, match="no such file"):
        load_profile(str(tmp_path / "none.toml"))
    bad = tmp_path / "latin.toml"
    bad.write_bytes(b'name = "\x81"')  # neither UTF-8 nor cp1252
    with pytest.raises(ProfileError, match="cannot be read"):
        load_profile(str(bad))


def test_the_good_profile_is_good():
    profile = parse_profile(GOOD, "my.toml")
    assert profile.bench.period_us == 1000 and profile.axis[0].circuit == "lift"


CHECKED = GOOD.replace('name = "luffing"', 'name = "luffing"\nmodel = "lift-flow.onnx"')


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('[stimulus]\nschedule = "none"', ["schedule 'none'", "lift-profile"]),
        (
            '[[axis]]\nname = "boom"\nmodel = "lift-flow.onnx"\ninitial_position_mm = 6000',
            ["my.toml: axis[1]", "stroke"],
        ),
    ],
)
def test_check_refuses_what_only_building_shows(tmp_path, capsys, more, words):
    profile = tmp_path / "my.toml"
    profile.write_text(f"{CHECKED}\n{more}\n")
    assert cli.main(["check", str(profile)]) == 2
    text = capsys.readouterr().err
    for word in words:
        assert word in text, text


def test_a_schedule_beside_the_profile_is_found_from_anywhere(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "bench"
    folder.mkdir()
    (folder / "mine.csv").write_text("time_s,valve_command\n0,0\n0.01,0.5\n")
    (folder / "my.toml").write_text(f'{CHECKED}\n[stimulus]\nschedule = "mine.csv"\n')
    monkeypatch.chdir(tmp_path)
    assert cli.main(["simulate", "--profile", "bench/my.toml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tick_count"] == 10


SHORT_LOAD = [
    ("", "[1000, 1900]", "[100.0, 150.0]", ["1000 to 1900 mm", "the stroke, 0 to 2000 mm", "44.4 kN at 0 mm and 155.6 kN at 2000 mm"]),
    ("", "[0, 1900]", "[100.0, 157.0]", ["0 to 1900 mm", "straight line to 160.0 kN at 2000 mm;", "position_range_mm"]),
    ("position_range_mm = [500, 1950]", "[500, 1900]", "[100.0, 170.0]", ["position_range_mm, 500 to 1950 mm", "172.5 kN"]),
    ("", "[-10, 2000]", "[100.0, 150.0]", []),
    ("position_range_mm = [500, 1900]", "[500, 1900]", "[100.0, 150.0]", []),
]  # fmt: skip


@pytest.mark.parametrize(("axis", "positions", "forces", "words"), SHORT_LOAD)
def test_a_load_that_ends_before_the_stroke_is_warned_of(tmp_path, capsys, axis, positions, forces, words):
    load = f'{axis}\n[axis.load]\nkind = "table"\nposition_mm = {positions}\ntable_force_kn = {forces}'
    profile = tmp_path / "my.toml"
    profile.write_text(f"{CHECKED}\n{load}\n")
    assert cli.main(["check", str(profile), "--json"]) == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert len(warnings) == bool(words)
    for word in [*words, f"{profile}: axis[0].load:", "remedy:"] if words else []:
        assert word in warnings[0], warnings
    assert cli.main(["simulate", "--profile", str(profile), "--duration", "0.01"]) == 0
    assert capsys.readouterr().out.count("warning:") == len(warnings)


def test_the_load_of_the_crane_ends_with_the_stroke_it_was_made_for(tmp_path, capsys):
    profile = tmp_path / "my.toml"
    profile.write_text(f"{CHECKED}\n[axis.parameters]\nstroke_mm = 2200.0\n")
    assert cli.main(["check", str(profile)]) == 0
    assert (
        "warning: " in (text := capsys.readouterr().out) and "0 to 2000 mm do not span the stroke, 0 to 2200 mm" in text
    )


def test_a_profile_runs_on_its_own_engine_unless_the_command_names_one(tmp_path, capsys):
    assert cli.main(["check", "paper-table1", "--json"]) == 0, "a profile that ships is sound without options"
    assert json.loads(capsys.readouterr().out)["engine"] == "reference"
    assert cli.main(["simulate", "--profile", "paper-table1", "--duration", "0.01", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["engine"] == "reference"
    assert cli.main(["check", "paper-table1", "--engine", "surrogate"]) == 2
    assert "axis[0].model" in capsys.readouterr().err
    profile = tmp_path / "my.toml"
    profile.write_text('name = "my"\n[[axis]]\nname = "luffing"\n')
    assert cli.main(["check", str(profile)]) == 2, "a model that was forgotten is no choice of an engine"
    text = capsys.readouterr().err
    assert all(word in text for word in ("axis[0].model", "missing", "[bench]", "--engine reference")), text
    profile.write_text('name = "my"\n[bench]\nengine = "network"\n[[axis]]\nname = "luffing"\n')
    assert cli.main(["check", str(profile)]) == 2
    text = capsys.readouterr().err
    assert all(word in text for word in ("bench.engine", "network", "surrogate, reference, onnx")), text


def test_check_warns_of_a_bus_that_cannot_carry_the_profile(tmp_path, capsys):
    profile = tmp_path / "my.toml"
    profile.write_text(f"{CHECKED}\n[can]\nbitrate = 125000\n")
    assert cli.main(["check", str(profile), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bus_load_ratio"] > 1 and "remedy" in found["warnings"][0]
    assert cli.main(["check", "amc-lift", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []
