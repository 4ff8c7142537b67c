"""The heave on the bus is the one that moves the load; a contract written before it, as older logs carry, has none."""

import re

import numpy as np
import pytest

from hilrunner.base import records, status
from hilrunner.plant.wave import heave_components, heave_series
from hilrunner.realtime.cycle import run_offline
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.contract import sent_signal_names, signal_tables
from hilrunner.setup.profile import load_profile
from hilrunner.setup.resources import firmware_interface_folder
from tests.tools import contract

PROFILE = """name = "heave"
[[axis]]
name = "boom"
circuit = "lift"
%s
[can]
dbc = "%s"
"""
WAVE = "[axis.wave]\nsignificant_height_m = 2.5\npeak_period_s = 8.0\nseed = 3"


def sent_at(loaded, tick):
    """Data bytes of the HEAVE_1 frame sent at a tick, run alone."""
    armed = arm_offline(loaded, status.ENGINE_REFERENCE)
    one, none = np.ones(1, np.int64), np.zeros(1, np.int64)
    command, state = (
        records.allocate(records.COMMAND, 1).reshape(1, 1),
        records.allocate(records.STATE, 1).reshape(1, 1),
    )
    frames, sizes = np.zeros((0, 72), np.uint8), np.zeros(0, np.int64)
    run_offline(armed.bench, tick * one, one, none, none, frames, sizes, np.zeros(2, np.int64), command, state)
    for frame in armed.bench.outbox.frame:
        if int.from_bytes(bytes(frame[:4]), "little") == 0x481:
            return bytes(frame[8:16]), float(state["load_scale"][0, 0])
    raise AssertionError("HEAVE_1 was not sent")


@pytest.mark.parametrize("wave", [WAVE, ""], ids=["wave", "calm"])
def test_the_heave_sent_is_the_heave_of_the_load(tmp_path, wave):
    (tmp_path / "p.toml").write_text(PROFILE % (wave, "actuator.dbc"))
    loaded = load_profile(str(tmp_path / "p.toml"))
    _, table = signal_tables(loaded)
    at = int(np.flatnonzero(table.can_id == 0x481)[0])
    tick = 4210 + int(table.phase[at])
    data, load_scale = sent_at(loaded, tick)
    decoded = contract.database().get_message_by_name("HEAVE_1").decode(data)
    if not wave:
        assert decoded["heave_position_mm"] == decoded["heave_velocity_mmps"] == 0 and load_scale == 1
        return
    z, dz, ddz = heave_series(heave_components(2.5, 8.0, 3), np.array([tick * 1e-3]))[0]
    assert abs(z) > 0.01
    assert decoded["heave_position_mm"] == pytest.approx(1000 * z, abs=0.0051)
    assert decoded["heave_velocity_mmps"] == pytest.approx(1000 * dz, abs=0.2501)
    assert load_scale == pytest.approx(1 + ddz / 9.81, rel=1e-12), "of the same moment"


def test_a_contract_without_heave_is_mapped_as_it_was(tmp_path):
    text = (firmware_interface_folder() / "actuator.dbc").read_text(encoding="utf-8")
    old = re.sub(r"(?m)^BO_ 115[3-6] HEAVE_.*\n( SG_.*\n)+\n|^.* 115[3-6] .*\n", "", text)
    assert "HEAVE_1" not in old
    (tmp_path / "old.dbc").write_text(old)
    (tmp_path / "p.toml").write_text(PROFILE % (WAVE, "old.dbc"))
    loaded = load_profile(str(tmp_path / "p.toml"))
    _, table = signal_tables(loaded)
    assert [hex(one) for one in table.can_id] == ["0x181", "0x281", "0x381"]
    assert not any("HEAVE" in name for name in sent_signal_names(loaded)) and len(sent_signal_names(loaded)) == 10
