"""Every form a command may come in: direction beside magnitude, currents, lines, several axes and frames, pages. cantools makes the frames."""

import cantools
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.realtime import decode
from hilrunner.setup import signals
from hilrunner.setup.mapping import (
    AxisMapping,
    CommandMapping,
    DirectionMapping,
    FrameMapping,
    LineMapping,
    SignalMapping,
)
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

MESSAGES = [
    Msg("FLOW", 100, 8, [
        Sig("Flow", 0, 8, scale="0.4", minimum="0", maximum="100", unit="%"), Sig("State", 16, 4), Sig("Mode", 20, 4),
    ]),
    Msg("BOTH", 0x18FE3021, 8, [
        Sig("Main", 7, 16, big_endian=True, scale="0.1", offset="-100", minimum="-100", maximum="100", unit="%"),
        Sig("Stick", 23, 16, big_endian=True, scale="0.1", offset="-100", minimum="-100", maximum="100", unit="%"),
        Sig("Mode", 32, 4),
    ], extended=True),
    Msg("COILS", 102, 8, [Sig("Ia", 0, 12, unit="mA"), Sig("Ib", 12, 12, unit="mA")]),
    Msg("LINES", 103, 2, [Sig("Enable", 0, 2), Sig("Dump", 2, 2), Sig("EStop", 4, 2), Sig("Reset", 6, 2), Sig("Word", 8, 8)]),
    Msg("PAGES", 104, 8, [
        Sig("Page", 0, 4, multiplex="M "), Sig("Alive", 4, 4),
        Sig("First", 8, 16, signed=True, scale="0.01", unit="%", multiplex="m1 "),
        Sig("Second", 8, 16, signed=True, scale="0.01", unit="%", multiplex="m2 "),
        Sig("On", 32, 1, multiplex="m2 "),
    ]),
]  # fmt: skip


class Rig:
    """A receiver of one mapping, and cantools as the sender."""

    def __init__(self, folder, commands):
        path = write(folder, MESSAGES)
        self.database = cantools.database.load_file(path, strict=False)
        stale = [50.0] * len(commands)
        self.table = signals.wire(path, [AxisMapping(one, []) for one in commands], stale_after_ms=stale).commands
        self.receiver = decode.new_receiver(self.table, len(commands))

    def give(self, name, tick=0, **values):
        """(axis, status) of one frame with these physical values, the other signals 0."""
        message = self.database.get_message_by_name(name)
        flags = decode.CAN_EFF_FLAG if message.is_extended_frame else 0
        values = {signal.name: 0 for signal in message.signals} | values
        if name == "PAGES":
            values = {
                one: values[one] for one in ("Page", "Alive", *(["First"] if values["Page"] == 1 else ["Second", "On"]))
            }
        data = codec_entries.padded(message.encode(values, strict=False))
        return codec_entries.decode_with(
            self.table, message.frame_id | flags, message.length, data, tick, self.receiver
        )

    def command(self, axis=0):
        """(valve command, control) of the newest command."""
        fresh = self.receiver.fresh[axis]
        return float(fresh["valve_command"]), int(fresh["control"])


VALID = (0, status.FRAME_VALID)
DIRECTION = DirectionMapping("State", extend=1, retract=2, block=[0, 4], float=3)


def test_a_direction_beside_the_magnitude(tmp_path):
    rig = Rig(tmp_path, [CommandMapping("FLOW", magnitude="Flow", direction=DIRECTION)])
    for state, sign in ((1, 1), (2, -1), (0, 0), (4, 0), (3, 0), (1, 1)):
        assert rig.give("FLOW", Flow=40, State=state) == VALID
        assert rig.command() == (pytest.approx(0.4 * sign), status.CONTROL_ACTIVE)
    assert rig.give("FLOW", Flow=10, State=5) == (0, status.FRAME_BAD_CONTROL)
    assert rig.command()[0] == pytest.approx(0.4), "nothing of a refused frame is used"
    assert rig.give("FLOW", Flow=100.4, State=1) == (0, status.FRAME_OUT_OF_RANGE)


def test_a_direction_may_name_values_of_the_database(tmp_path):
    path = write(tmp_path, MESSAGES)
    path.write_text(
        path.read_text() + 'VAL_ 100 State 0 "Neutral" 1 "Extend cylinder" 2 "Retract cylinder" 3 "Float" ;\n'
    )
    for direction in (
        "State",
        DirectionMapping("State", extend="extend cylinder", retract="Retract cylinder", block="neutral"),
    ):
        command = CommandMapping("FLOW", magnitude="Flow", direction=direction)
        table = signals.load_signals(path, [AxisMapping(command, [])])[0]
        assert dict(zip(table.value_number, table.value_meaning, strict=True))[2.0] == -1.0
    with pytest.raises(DbcError, match=r"its value table has no 'out'.*Neutral \(0\)"):
        command = CommandMapping("FLOW", magnitude="Flow", direction=DirectionMapping("State", extend="out", retract=2))
        signals.load_signals(path, [AxisMapping(command, [])])


def test_one_solenoid_current_an_edge(tmp_path):
    full = {"deadband": 300.0, "full": 700.0}
    command = CommandMapping("COILS", current_a=SignalMapping("Ia", **full), current_b=SignalMapping("Ib", **full))
    rig = Rig(tmp_path, [command])
    for a, b, expected in (
        (0, 0, 0),
        (300, 0, 0),
        (500, 0, 0.5),
        (700, 0, 1),
        (900, 0, 1),
        (0, 400, -0.25),
        (700, 700, 0),
    ):
        assert rig.give("COILS", Ia=a, Ib=b) == VALID
        assert rig.command()[0] == pytest.approx(expected)


def test_a_characteristic_by_points(tmp_path):
    points = [(350.0, 0.0), (400.0, 5.0), (600.0, 60.0), (650.0, 100.0)]
    command = CommandMapping("COILS", current_a=SignalMapping("Ia", curve=points, unit="%"))
    rig = Rig(tmp_path, [command])
    for current, percent in ((0, 0), (350, 0), (375, 2.5), (400, 5), (500, 32.5), (650, 100), (4095, 100)):
        rig.give("COILS", Ia=current)
        assert rig.command()[0] == pytest.approx(percent / 100)


def test_lines_are_inputs_of_the_state_machine(tmp_path):
    safety = LineMapping("EStop", off=1)  # a closed loop reads 1
    command = CommandMapping(
        "FLOW", magnitude="Flow", direction=DIRECTION, reset=LineMapping("Reset", message="LINES"), safety=LineMapping("EStop", message="LINES", off=1),
        enable=LineMapping("Enable", message="LINES"), dump=LineMapping("Dump", message="LINES"),
    )  # fmt: skip
    assert safety.on is None
    rig = Rig(tmp_path, [command])
    ready = {"Enable": 1, "EStop": 1}
    rig.give("FLOW", Flow=20, State=1)
    assert rig.receiver.fresh[0]["control"] == 0, "no command before all its messages have come"
    for change, control in (
        ({}, status.CONTROL_ACTIVE), ({"Enable": 0}, status.CONTROL_DISABLED), ({"Enable": 3}, status.CONTROL_DISABLED),
        ({"Dump": 1}, status.CONTROL_HOLD), ({"Dump": 3}, status.CONTROL_HOLD), ({"EStop": 0}, status.CONTROL_TRIP),
        ({"EStop": 2}, status.CONTROL_TRIP), ({"Reset": 1}, status.CONTROL_RESET), ({"Reset": 1, "EStop": 0}, status.CONTROL_TRIP),
    ):  # fmt: skip
        assert rig.give("LINES", **ready | change) == VALID
        assert rig.command() == (pytest.approx(0.2), control), change


def test_several_axes_in_one_frame(tmp_path):
    words = {"control": "Mode", "control_values": {"hold": 0, "active": 1}}
    rig = Rig(tmp_path, [CommandMapping("BOTH", valve_command=name, **words) for name in ("Main", "Stick")])
    assert len(rig.table.frames) == 1 and rig.table.can_id[0] == 0x18FE3021 | decode.CAN_EFF_FLAG
    assert rig.give("BOTH", Main=30, Stick=-60, Mode=1) == VALID
    assert rig.command(0) == (pytest.approx(0.3), 2) and rig.command(1) == (pytest.approx(-0.6), 2)
    assert rig.give("BOTH", Main=50, Stick=200, Mode=1) == (1, status.FRAME_OUT_OF_RANGE)
    assert rig.command(0)[0] == pytest.approx(0.5) and rig.command(1)[0] == pytest.approx(-0.6), "each axis by itself"
    assert rig.give("BOTH", Main=0, Stick=0, Mode=7) == (0, status.FRAME_BAD_CONTROL)


def test_several_frames_for_one_axis_age_with_the_oldest(tmp_path):
    command = CommandMapping(
        "FLOW", magnitude="Flow", direction=DIRECTION, enable=LineMapping("Enable", message="LINES")
    )
    rig = Rig(tmp_path, [command])
    rig.give("LINES", tick=3, Enable=1)
    for tick in (5, 9, 14):
        rig.give("FLOW", tick=tick, Flow=20, State=1)
        assert rig.receiver.fresh[0]["valid_tick"] == 3
    slow = CommandMapping(
        "FLOW", magnitude="Flow", direction=DIRECTION, enable=LineMapping("Enable", message="LINES"),
        frames=[FrameMapping("LINES", stale_after_ms=60.0)],
    )  # fmt: skip
    rig = Rig(tmp_path, [slow])
    rig.give("LINES", tick=3, Enable=1)
    rig.give("FLOW", tick=9, Flow=20, State=1)
    assert rig.receiver.fresh[0]["valid_tick"] == 9
    rig.give("FLOW", tick=20, Flow=20, State=1)
    assert rig.receiver.fresh[0]["valid_tick"] == 13, "10 ms older than the axis' 50 ms may be"


def test_multiplexed_commands(tmp_path):
    first = CommandMapping("PAGES", valve_command=SignalMapping("First", range=(-100.0, 100.0)))
    second = CommandMapping("PAGES", valve_command=SignalMapping("Second", range=(-100.0, 100.0)), enable="On")
    rig = Rig(tmp_path, [first, second])
    assert rig.give("PAGES", tick=1, Page=1, First=25) == VALID
    assert rig.command(0)[0] == 0.25 and rig.receiver.group_status[1] == 255
    assert rig.give("PAGES", tick=2, Page=2, Second=-50, On=1)[1] == status.FRAME_VALID
    assert rig.command(1) == (-0.5, status.CONTROL_ACTIVE) and rig.command(0)[0] == 0.25
    assert rig.give("PAGES", tick=3, Page=2, Second=-50, On=0)[1] == status.FRAME_VALID
    assert rig.command(1)[1] == status.CONTROL_DISABLED


@pytest.mark.parametrize(
    "command, text",
    [
        (CommandMapping("FLOW"), "in 0 forms"),
        (CommandMapping("FLOW", valve_command="Flow", magnitude="Flow", direction=DIRECTION), "in 2 forms"),
        (CommandMapping("FLOW", magnitude="Flow"), "`direction` is missing"),
        (CommandMapping("FLOW", magnitude="Flow", direction="State"), "extend and retract at the least"),
        (CommandMapping("FLOW", magnitude="Flow", direction=DirectionMapping("State", extend=1, retract=1)), "one value twice"),
        (CommandMapping("FLOW", magnitude="Flow", direction=DirectionMapping("State", extend=1, retract=16)), "16 is not a value of its 4 bits"),
        (CommandMapping("COILS", current_a="Ia"), "says nothing of the opening"),
        (CommandMapping("COILS", current_a=SignalMapping("Ia", full=100.0, deadband=100.0)), "0 <= deadband < full"),
        (CommandMapping("COILS", current_a=SignalMapping("Ia", curve=[(0.0, 0.0), (0.0, 1.0)])), "two points at one physical value"),
        (CommandMapping("COILS", current_a=SignalMapping("Ia", curve=[(0.0, 0.0), (9.0, 90.0)])), "asks for 0 to 90 of the valve"),
        (CommandMapping("FLOW", valve_command="Flow", frames=[FrameMapping("COILS")]), "no signal of this message is mapped"),
        (CommandMapping("FLOW", valve_command="Flow", control_values={"active": 1}), "without `control`"),
    ],
)  # fmt: skip
def test_mappings_that_contradict_themselves(tmp_path, command, text):
    with pytest.raises(DbcError) as error:
        signals.load_signals(write(tmp_path, MESSAGES), [AxisMapping(command, [])])
    assert text in str(error.value)


def test_two_axes_must_say_the_same_of_one_message(tmp_path):
    commands = [
        CommandMapping("BOTH", valve_command="Main", protection="none"),
        CommandMapping("BOTH", valve_command="Stick", protection={"x": 1}),
    ]
    with pytest.raises(DbcError, match="two axes give it different protection"):
        signals.load_signals(write(tmp_path, MESSAGES), [AxisMapping(command, []) for command in commands])


def test_counters_of_a_page_nobody_maps_move_on(tmp_path):
    from hilrunner.setup.mapping import Protection

    command = CommandMapping(
        "PAGES", valve_command=SignalMapping("First", range=(-100.0, 100.0)), protection=Protection(counter="Alive")
    )
    rig = Rig(tmp_path, [command])
    for alive in range(40):
        page = 1 if alive % 2 else 2
        assert rig.give("PAGES", Page=page, Alive=alive % 16)[1] == status.FRAME_VALID
    assert np.array_equal(rig.receiver.last_counter, [39 % 16])
    assert rig.give("PAGES", Page=1, Alive=39 % 16)[1] == status.FRAME_REPEATED_COUNTER
