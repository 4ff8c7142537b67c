"""No number of a profile makes work or state without bound: it is refused with its range, and what is slow hears Ctrl-C."""

import json
import os
import time
from collections import Counter

import numpy as np
import pytest
from drawn_profiles import Drawing
from profile_trial import LEFT_THE_NUMBERS, RAN, tried

from hilrunner import cli
from hilrunner.base import status
from hilrunner.base.errors import ProfileError
from hilrunner.setup import blocks, period_cost
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.axes import SUBSTEPS_MAX, make_axis_plants, reference_plants
from hilrunner.setup.profile import LoadedProfile, load_profile, parse_profile
from tests.tools.error_lines import error_lines

GOOD = 'name = "x"\n[bench]\nengine = "reference"\n[[axis]]\nname = "a"\n'


def loaded_from(text, tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(text)
    return load_profile(str(path))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('[axis.load]\nkind = "constant"\nforce_kn = 1e300', ["force_kn", "1e+300", "-100000 to 100000"]),
        ('[axis.load]\nkind = "table"\nposition_mm = [0.0, 1e9]\ntable_force_kn = [1.0, 1.0]', ["position_mm", "100000"]),
        (f'[axis.load]\nkind = "table"\nposition_mm = {list(range(200))}', ["position_mm", "129"]),
        ("[axis.wave]\nsignificant_height_m = 1.0\npeak_period_s = 8.0\nseed = 99999999999999999999999", ["axis"]),
        ("[deadline.lateness_us]\nmax = 9223372036854775807", ["deadline.lateness_us.max", "1000000000000"]),
        ("[crosscheck]\npressure_tolerance_mpa = 1e9", ["pressure_tolerance_mpa", "above 0 to 1000"]),
        ('[[fault]]\nkind = "load-factor"\naxis = "a"\nat_s = 0.0\nload_factor = 1e300', ["load_factor", "-100 to 100"]),
        (f"[limits]\nfoo = {'[' * 3000}1{']' * 3000}", ["nested too deeply"]),
        (f"[limits]\n{'.'.join('a' * 3000)} = 1", ["p.toml"]),
        (f"[axis.parameters]\nmass_kg = {'9' * 5000}", ["p.toml"]),
        ('[can]\ndbc = "a\\u0000b"', ["can.dbc"]),
        (f'[can]\ndbc = "{"a" * 5000}"', ["can.dbc", "1024"]),
        ("[axis.network]\n\"hil.circuit\" = 1979-05-27", ["axis[0].network", "JSON"]),
    ],
)  # fmt: skip
def test_what_scales_work_or_state_has_a_range(more, words):
    with pytest.raises(ProfileError) as caught:
        parse_profile(f"{GOOD}{more}\n", "p.toml")
    text = str(caught.value)
    assert len(text) < 1500, text
    for word in words:
        assert word in text, text


STIFF = (
    "[axis.parameters]\nbulk_modulus_mpa = 5000.0\ndead_volume_1_mm3 = 1.0\ndead_volume_2_mm3 = 1.0\nmass_kg = 0.1\n"
)


def test_a_plant_that_needs_millions_of_steps_a_period_is_refused_before_it_runs(tmp_path, capsys):
    loaded = loaded_from(GOOD + STIFF, tmp_path)
    with pytest.raises(
        ProfileError, match=f"RK4 steps of .* in each period of 1000 us.*at most {SUBSTEPS_MAX}.*soften"
    ):
        make_axis_plants(loaded, status.ENGINE_REFERENCE)
    with pytest.raises(ProfileError):
        reference_plants(loaded)
    assert cli.main(["check", str(loaded.path)]) == 2
    (line,) = error_lines(capsys.readouterr().err)
    assert "p.toml: axis[0]: needs " in line


def test_check_refuses_what_cannot_keep_its_period(monkeypatch, tmp_path, capsys):
    loaded = loaded_from(GOOD, tmp_path)
    assert cli.main(["check", str(loaded.path), "--json"]) == 0
    assert 0 < json.loads(capsys.readouterr().out)["period_cost_us"] < 1000
    monkeypatch.setattr(period_cost, "period_cost_s", lambda armed: 0.0032)
    assert cli.main(["check", str(loaded.path)]) == 2
    text = capsys.readouterr().err
    assert all(word in text for word in ("bench.period_us", "3200 us", "a: ", "substeps", "below 1000 us")), text


def test_a_profile_is_a_small_regular_file(tmp_path):
    path = tmp_path / "huge.toml"
    with open(path, "wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ProfileError, match="at most 4 MiB"):
        load_profile(str(path))
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(ProfileError, match="a pipe or a device"):
        load_profile(str(tmp_path / "pipe.toml"))


def test_blocks_of_compiled_work_stay_short_whatever_a_tick_costs(monkeypatch):
    """Compiled code hears no Ctrl-C: a block ends long before a second is over."""
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    for cost_s, most in ((1e-6, 1000), (0.001, 1000), (0.04, 1000), (3.0, 1000)):
        sizes, done = [], 0
        for start, stop in blocks.blocks(500, most):
            assert start == done
            clock[0] += cost_s * (stop - start)
            done = stop
            sizes.append(stop - start)
        assert done == 500
        assert max(sizes) * cost_s <= max(2 * blocks.BLOCK_S, cost_s)


def test_a_load_that_no_stop_could_bear_is_refused(tmp_path):
    """It would press the rod so deep into its stop that a chamber is empty, and the state leaves the finite numbers."""
    text = GOOD + '[[fault]]\nkind = "load-factor"\naxis = "a"\nat_s = 0.0\nload_factor = {}\n'
    arm_offline(loaded_from(text.format(1.5), tmp_path), status.ENGINE_REFERENCE)
    with pytest.raises(ProfileError, match=r"fault\[0\].load_factor: -80 times .* kN presses the rod .* either way"):
        arm_offline(loaded_from(text.format(-80.0), tmp_path), status.ENGINE_REFERENCE)


def test_what_is_drawn_unspoilt_is_refused_at_reading_for_a_long_period_alone():
    """Any other reason would mean that the drawing has not followed the format, so that too few drawn profiles reach a bench."""
    drawing = Drawing(np.random.default_rng(3), wrong=0.0)
    for _ in range(300):
        try:
            parse_profile(drawing.text(), "p.toml")
        except ProfileError as error:
            assert "stale_after_ms" in error.place and "shorter than one period" in error.problem, error


def test_drawn_profiles_run_or_are_refused_in_one_line(tmp_path):
    drawing = Drawing(np.random.default_rng(2), wrong=0.004)
    outcomes = Counter(tried(drawing.text(), tmp_path)[0] for _ in range(40))
    assert outcomes[RAN] >= 5 and not outcomes[LEFT_THE_NUMBERS], outcomes
    assert isinstance(loaded_from(GOOD, tmp_path), LoadedProfile)
