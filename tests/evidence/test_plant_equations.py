"""Which plant a log's run had: newer plants are for newer logs, older logs keep their bits."""

import numpy as np
import pytest

from hilrunner import cli
from hilrunner.base import status
from hilrunner.base.errors import LogError
from hilrunner.evidence import rebuild, replay
from hilrunner.evidence.reader import read_run
from hilrunner.setup.axes import build_axes, reference_plants
from tests.tools.copy_log import copy_with

SCHEDULE = """kind = "table"
duration_s = 0.4
times_s = [0.0, 0.05, 0.2]
commands = [0.0, 0.8, -0.6]
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A run whose command steps: some of its periods are handed over."""
    folder = tmp_path_factory.mktemp("equations")
    (folder / "steps.toml").write_text(SCHEDULE)
    words = ["simulate", "--schedule", str(folder / "steps.toml"), "--out", str(folder / "run.mcap"), "--json"]
    assert cli.main(words) == 0
    return folder / "run.mcap"


def with_equations(log, tmp_path, equations: str | None):
    """A copy of the log whose metadata names other equations, or none as logs of earlier versions."""
    path = tmp_path / "copy.mcap"

    def change(name, table):
        if name == "run":
            table.pop("plant_equations", None)
            if equations is not None:
                table["plant_equations"] = equations
        return table

    copy_with(log, path, change_metadata=change)
    return path


def test_a_log_names_its_equations_and_replays_with_them(log):
    run = read_run(log)
    assert run.metadata["run"]["plant_equations"] == str(status.PLANT_EQUATIONS)
    assert (run.state["luffing"]["flags"] & status.FLAG_EXACT_STEP).any(), "else the next test says nothing"
    assert replay.build_replay(log, replay.ReplayOptions(part=replay.EXACT)).exact.identical


def test_a_log_that_names_none_gets_the_first_plant(log, tmp_path):
    run = read_run(with_equations(log, tmp_path, None))
    with rebuild.unpacked_profile(run) as loaded:
        (plant,) = build_axes(loaded, status.ENGINE_SURROGATE).plants
        (judge,) = reference_plants(loaded)
    assert loaded.plant_equations == 1
    assert plant.exact_substep_count == 0
    assert not plant.parameters["void_pa"].any() and not judge.parameters["void_pa"].any()
    result = replay.build_replay(run.path, replay.ReplayOptions(part=replay.EXACT))
    assert not result.exact.identical, "this run had the second"


@pytest.mark.parametrize("told", ["3", "0", "-1", "two", "", "1" * 5000])
def test_equations_this_version_does_not_know_are_refused(log, tmp_path, told):
    run = read_run(with_equations(log, tmp_path, told))
    with pytest.raises(LogError, match="equations") as refused, rebuild.unpacked_profile(run):
        pass
    assert len(str(refused.value)) < 500


def test_the_present_plant_has_both(log):
    with rebuild.unpacked_profile(read_run(log)) as loaded:
        (plant,) = build_axes(loaded, status.ENGINE_SURROGATE).plants
        (judge,) = reference_plants(loaded)
    assert plant.exact_substep_count == judge.substep_count == 20 and np.all(plant.parameters["void_pa"] > 0.0)


def test_a_surrogate_is_judged_with_the_mass_of_its_spools(tmp_path):
    """Also where the profile's own reference leaves it out; a run of that reference is judged by itself."""
    from hilrunner.setup.profile import load_profile

    text = load_profile("amc-lift").text.replace('preset = "lift"', 'preset = "lift"\nreference = "fast"')
    (tmp_path / "fast.toml").write_text(text)
    loaded = load_profile(str(tmp_path / "fast.toml"))
    assert [plant.fast for plant in reference_plants(loaded)] == [False]
    assert [plant.fast for plant in reference_plants(loaded, status.ENGINE_REFERENCE)] == [True]
