"""Profiles: what ships is sound; what is wrong is refused with the place, the value, the limit and the remedy."""

import pytest

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
        (('name = "x"', 'name = "x'), ["not TOML"]),
        (('name = "x"', ""), ["name"]),
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
    bad.write_bytes(b'name = "\xff"')
    with pytest.raises(ProfileError, match="cannot be read"):
        load_profile(str(bad))


def test_the_good_profile_is_good():
    profile = parse_profile(GOOD, "my.toml")
    assert profile.bench.period_us == 1000 and profile.axis[0].circuit == "lift"
