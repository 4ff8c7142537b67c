"""The places in a network's training range are those its inputs really had: the ones the plant step asks the network with."""

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.state_layout import STATE_SIZE
from hilrunner.evidence.training_range import places_in_range
from hilrunner.plant.head import FORM_PLAIN, FORM_SHARE
from hilrunner.setup.axes import build_axes
from hilrunner.setup.profile import load_profile


@pytest.fixture(scope="module")
def paper():
    return build_axes(load_profile("paper"), status.ENGINE_SURROGATE)


def places(paper, count=50):
    """Of states around the start, with the spool on its open stop, under commands that open the valve."""
    plant = paper.plants[0]
    states = np.tile(paper.initial_states[0], (count, 1))
    assert states.shape[1] == STATE_SIZE
    commands = np.linspace(0.2, 0.9, count)
    return states, commands, places_in_range(plant, states, commands, np.linspace(1.0, 2.0, count))


def test_the_flow_network_is_placed_within_its_range(paper):
    """Its inputs are p1, the root of p2 and the spool's share: as p1, p2 and command the second had a share of 216."""
    states, commands, found = places(paper)
    (mlp,) = paper.plants[0].networks.networks.values()
    assert mlp.form == FORM_SHARE
    assert [place.name for place in found] == list(mlp.input_names)
    assert all(-0.01 <= place.share_at_worst <= 1.01 for place in found), [place.share_at_worst for place in found]
    assert found[0].at_worst == pytest.approx(states[-1, 2])
    prm = paper.plants[0].parameters[0]
    over_tank = states[-1, 3] - prm["tank_pressure_pa"]
    assert found[1].at_worst == pytest.approx(np.sign(over_tank) * np.sqrt(abs(over_tank)), rel=0.01)
    drain = prm["valve_bt_si"] * commands[-1]
    assert found[2].at_worst == pytest.approx(prm["cbv_si"] / (prm["cbv_si"] + drain), rel=1e-9)


def test_a_network_in_plain_quantities_is_placed_by_those(paper):
    (mlp,) = paper.plants[0].networks.networks.values()
    object.__setattr__(mlp, "form", FORM_PLAIN)
    try:
        states, commands, found = places(paper)
        assert [place.at_worst for place in found][:3] == pytest.approx([states[-1, 2], states[-1, 3], commands[-1]])
    finally:
        object.__setattr__(mlp, "form", FORM_SHARE)


def test_a_shut_valve_asks_no_flow_network(paper):
    plant = paper.plants[0]
    states = np.tile(paper.initial_states[0], (5, 1))
    assert places_in_range(plant, states, np.zeros(5), np.ones(5)) == []
