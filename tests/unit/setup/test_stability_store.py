"""The kept stability limit: the same number as computed, computed again when the plant or the file is another."""

from dataclasses import replace

import pytest

from hilrunner.base import status
from hilrunner.setup import stability_store
from hilrunner.setup.axes import reference_plants
from hilrunner.setup.profile import load_profile


@pytest.fixture
def plant():
    return reference_plants(load_profile("amc-lift"))[0]


@pytest.fixture
def store(tmp_path, monkeypatch):
    """An empty store, and how often the limit was computed."""
    computed = []

    def limit_s(plant):
        computed.append(plant)
        return 5.1e-5 + 1e-9 * len(computed)

    monkeypatch.setattr(stability_store, "cache_folder", lambda room: tmp_path / room)
    monkeypatch.setattr(stability_store, "stability_limit_s", limit_s)
    return computed


def test_the_second_start_reads_what_the_first_computed(plant, store):
    first = stability_store.stored_stability_limit_s(plant)
    assert stability_store.stored_stability_limit_s(plant) == first
    assert len(store) == 1


def test_another_plant_is_another_limit(plant, store):
    heavier = replace(plant, parameters=plant.parameters.copy())
    heavier.parameters["mass_kg"] *= 2
    changed = [
        plant,
        heavier,
        replace(plant, fast=True),
        replace(plant, circuit=status.CIRCUIT_LIFT_LINES),
        replace(plant, position_range_m=(0.1, 0.9)),
    ]
    limits = {stability_store.stored_stability_limit_s(one) for one in changed}
    assert len(limits) == len(store) == len(changed)


@pytest.mark.parametrize("damage", ["", "nan", "-0x1p-14", "zero"])
def test_a_damaged_file_is_computed_again(plant, store, tmp_path, damage):
    stability_store.stored_stability_limit_s(plant)
    (kept,) = (path for path in tmp_path.rglob("*") if path.is_file())
    kept.write_text(damage)
    assert stability_store.stored_stability_limit_s(plant) == pytest.approx(5.1e-5, rel=1e-3)
    assert len(store) == 2


def test_a_store_that_cannot_be_written_costs_only_time(plant, store, tmp_path):
    (tmp_path / "plant").write_text("in the way")
    assert stability_store.stored_stability_limit_s(plant) > 0
    assert stability_store.stored_substep_count(plant, 1e-3) == 21
