"""Counters and checksums of any kind, sent and received, against independent code: autosar-e2e, crccheck, sums by hand, J1939's formula."""

import crccheck.crc
import e2e.p01
import e2e.p02
import e2e.p04
import e2e.p05
import e2e.p06
import e2e.p07
import e2e.p11
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.realtime import decode, encode
from hilrunner.setup import signals
from hilrunner.setup.crc_names import named_crc
from hilrunner.setup.mapping import AxisMapping, CommandMapping, MeasurementMapping, Protection, SignalMapping
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

SEED = 20251128
DATA_ID = 0x0A37


def bench(folder, protection, length=8, where=0, extra=(), can_id=0x123, extended=False, max_counter_delta=2):
    """(command table, measurement table) whose command and measurement have one layout: a valve signal in the last free bytes."""
    valve = Sig(
        "Valve",
        8 * (where or length - 2),
        16,
        signed=True,
        scale="0.01",
        minimum="-100",
        maximum="100",
        unit="%",
    )
    messages = [
        Msg("CMD", can_id, length, [valve, *extra], extended),
        Msg("SENS", can_id + 1, length, [valve, *extra], extended),
    ]
    mapped = AxisMapping(
        CommandMapping("CMD", valve_command="Valve", protection=protection, max_counter_delta=max_counter_delta),
        [MeasurementMapping("SENS", {"valve_command": "Valve"}, protection=protection)],
    )
    return signals.load_signals(write(folder, messages), [mapped])


class Ends:
    """The bench as sender and as receiver of one protection."""

    def __init__(self, folder, protection, **words):
        self.commands, self.measurements = bench(folder, protection, **words)
        self.quantities, self.sent = encode.no_quantities(1), encode.send_counters(self.measurements)
        self.receiver = decode.new_receiver(self.commands, 1)

    def send(self, value=0.25) -> bytearray:
        """The next frame the bench sends."""
        self.quantities[0, encode.QUANTITY_VALVE_COMMAND] = value
        data = np.full(64, 0xA5, np.uint8)
        length = codec_entries.encode_one(self.measurements, 0, self.quantities, self.sent, data)
        return bytearray(data[:length])

    def receive(self, frame) -> int:
        """What the bench makes of a frame."""
        can_id, data = int(self.commands.can_id[0]), codec_entries.padded(bytes(frame))
        before = data.copy()
        code = codec_entries.decode_with(self.commands, can_id, len(frame), data, 0, self.receiver)[1]
        assert np.array_equal(before, data), "a received frame stays as it was, for the log"
        return int(code)


def flip_every_bit(ends, make, covered, other_counters=0):
    """A right frame is taken once; with one bit wrong it is refused."""
    for bit in range(8 * covered):
        frame = make()
        frame[bit // 8] ^= 1 << bit % 8
        assert ends.receive(frame) != status.FRAME_VALID, bit


AUTOSAR = [
    (Protection(profile="P01", data_id=DATA_ID), "p01", {"data_id_mode": e2e.p01.E2E_P01_DATAID_BOTH}, 8, 15),
    (Protection(profile="P01", data_id=DATA_ID, data_id_mode="low"), "p01", {"data_id_mode": e2e.p01.E2E_P01_DATAID_LOW}, 8, 15),
    (Protection(profile="P01", data_id=DATA_ID, data_id_mode="alternating", offset_bytes=2), "p01", {"data_id_mode": e2e.p01.E2E_P01_DATAID_ALT, "offset": 2}, 8, 15),
    (Protection(profile="P01", data_id=DATA_ID, data_id_mode="nibble"), "p01", {"data_id_mode": e2e.p01.E2E_P01_DATAID_NIBBLE}, 8, 15),
    (Protection(profile="P11", data_id=DATA_ID), "p11", {"data_id_mode": e2e.p11.E2E_P11_DATAID_BOTH}, 8, 15),
    (Protection(profile="P11", data_id=DATA_ID, data_id_mode="nibble", offset_bytes=3), "p11", {"data_id_mode": e2e.p11.E2E_P11_DATAID_NIBBLE, "offset": 3}, 16, 15),
    (Protection(profile="P04", data_id=0xA1B2C3D4), "p04", {}, 24, 1 << 16),
    (Protection(profile="P04", data_id=0xA1B2C3D4, offset_bytes=4), "p04", {"offset": 4}, 64, 1 << 16),
    (Protection(profile="P05", data_id=DATA_ID), "p05", {}, 8, 256),
    (Protection(profile="P05", data_id=DATA_ID, offset_bytes=1), "p05", {"offset": 1}, 64, 256),
    (Protection(profile="P06", data_id=DATA_ID), "p06", {}, 8, 256),
    (Protection(profile="P06", data_id=DATA_ID, offset_bytes=7), "p06", {"offset": 7}, 32, 256),
    (Protection(profile="P07", data_id=0xA1B2C3D4), "p07", {}, 32, 1 << 32),
    (Protection(profile="P07", data_id=0xA1B2C3D4, offset_bytes=8), "p07", {"offset": 8}, 64, 1 << 32),
]  # fmt: skip
NAMES = [f"{one.profile}-{one.data_id_mode}-{one.offset_bytes}" for one, *_ in AUTOSAR]


@pytest.mark.parametrize("protection, module, words, length, modulus", AUTOSAR, ids=NAMES)
def test_autosar_profiles_are_those_of_autosar_e2e(tmp_path, protection, module, words, length, modulus):
    library = getattr(e2e, module)
    protect, check = getattr(library, f"e2e_{module}_protect"), getattr(library, f"e2e_{module}_check")
    ends = Ends(tmp_path, protection, length=length)
    theirs = bytearray(ends.send(0.0))
    first = bytearray(theirs)
    protect(first, protection.data_id, length=length, increment_counter=False, **words)
    assert bytes(first) == bytes(theirs), "the first frame, counter 0"
    for number in range(1, 40 if modulus < 256 else 300):
        ours = ends.send(number / 300)
        assert check(bytearray(ours), protection.data_id, length=length, **words), number
        theirs[length - 2 :] = ours[length - 2 :]
        protect(theirs, protection.data_id, length=length, **words)  # moves their counter on
        assert bytes(ours) == bytes(theirs), number
        assert ends.receive(theirs) == status.FRAME_VALID
        assert ends.receive(theirs) == status.FRAME_REPEATED_COUNTER
    assert ends.receiver.fresh[0]["valve_command"] == pytest.approx(number / 300, abs=5e-5)


@pytest.mark.parametrize("protection, module, words, length, modulus", AUTOSAR, ids=NAMES)
def test_a_wrong_bit_anywhere_is_found(tmp_path, protection, module, words, length, modulus):
    ends = Ends(tmp_path, protection, length=length)
    good = ends.send()
    flip_every_bit(ends, lambda: bytearray(good), length)
    assert ends.receive(good) == status.FRAME_VALID


def test_lost_frames_resynchronise(tmp_path):
    ends = Ends(tmp_path, Protection(profile="P05", data_id=7), max_counter_delta=3)
    frames = [ends.send() for _ in range(300)]
    assert [ends.receive(frames[at]) for at in (250, 253, 257, 258, 3 + 256)] == [
        status.FRAME_VALID, status.FRAME_VALID, status.FRAME_LOST_COUNTER, status.FRAME_VALID, status.FRAME_VALID,
    ]  # fmt: skip
    assert ends.receive(frames[20]) == status.FRAME_LOST_COUNTER and ends.receive(frames[21]) == status.FRAME_VALID


def test_profile_1_never_takes_counter_15(tmp_path):
    ends = Ends(tmp_path, Protection(profile="P01", data_id=DATA_ID))
    frame = ends.send()
    frame[1] |= 0x0F
    e2e.p01.e2e_p01_protect(frame, DATA_ID, length=8, increment_counter=False)
    frame[1] |= 0x0F
    rest = bytes([DATA_ID & 0xFF, DATA_ID >> 8]) + bytes(frame[1:])
    frame[0] = crccheck.crc.Crc(8, 0x1D, 0, False, False, 0).calc(rest)
    assert ends.receive(frame) == status.FRAME_BAD_CRC


COUNTER, SUM8 = Sig("Alive", 52, 4), Sig("Check", 56, 8)


@pytest.mark.parametrize(
    "width, modulus, first",
    [(4, None, None), (4, 15, 1), (2, None, None), (8, 200, 7), (13, None, None), (1, None, None)],
)
def test_a_plain_counter_wraps_where_it_says(tmp_path, width, modulus, first):
    protection = Protection(counter="Alive", counter_modulus=modulus, counter_first=first)
    ends = Ends(tmp_path, protection, extra=[Sig("Alive", 20, width)], where=6, max_counter_delta=1)
    wrap = modulus or 1 << width
    seen = []
    for _ in range(2 * min(wrap, 300) + 3):
        frame = ends.send()
        seen.append(int.from_bytes(frame, "little") >> 20 & (1 << width) - 1)
        assert ends.receive(frame) == status.FRAME_VALID and (ends.receive(frame) == status.FRAME_REPEATED_COUNTER)
    assert seen == [((first or 0) + number) % wrap for number in range(len(seen))]


def counted(protection, extra, tmp_path, **words):
    return Ends(tmp_path, protection, extra=extra, **words)


@pytest.mark.parametrize("algorithm, by_hand", [
    ("sum", lambda data: sum(data) & 0xFF),
    ("xor", lambda data: int(np.bitwise_xor.reduce(np.frombuffer(bytes(data), np.uint8)))),
    ("nibble-sum", lambda data: sum((byte & 15) + (byte >> 4) for byte in data) & 0xFF),
])  # fmt: skip
def test_sums_by_hand(tmp_path, algorithm, by_hand):
    ends = counted(
        Protection(counter="Alive", checksum="Check", algorithm=algorithm), [COUNTER, SUM8], tmp_path, where=2
    )
    for number in range(40):
        frame = ends.send(number / 100)
        assert frame[7] == by_hand(frame[:7])
        assert ends.receive(frame) == status.FRAME_VALID
    frame = ends.send()
    frame[2] ^= 1
    assert ends.receive(frame) == status.FRAME_BAD_CRC


def test_sums_over_identifier_length_and_chosen_bytes(tmp_path):
    """As Toyota does it: identifier, length and data; and one negated over a part."""
    ends = counted(
        Protection(checksum="Check", algorithm="sum", include=["id", "length"]), [SUM8], tmp_path, where=2, can_id=0x2E4
    )
    frame = ends.send()
    assert frame[7] == (0x2 + 0xE5 + 8 + sum(frame[:7])) & 0xFF
    (tmp_path / "b").mkdir()
    words = {
        "first_byte": 2,
        "last_byte": 5,
        "start": 0x10,
        "negated": True,
        "final_xor": 0x0F,
        "before": [1, 2],
        "after": [3],
    }
    ends = counted(Protection(checksum="Check", algorithm="sum", **words), [SUM8], tmp_path / "b", where=2)
    frame = ends.send()
    assert frame[7] == (-(0x10 + 1 + 2 + sum(frame[2:6]) + 3) & 0xFF) ^ 0x0F


def test_a_checksum_of_a_nibble_counts_its_own_bits_as_zero(tmp_path):
    ends = counted(
        Protection(counter="Alive", checksum="Check", algorithm="xor"),
        [Sig("Alive", 48, 4), Sig("Check", 52, 4)],
        tmp_path,
        where=2,
    )
    for _ in range(20):
        frame = ends.send()
        blank = bytearray(frame)
        blank[6] &= 0x0F
        assert frame[6] >> 4 == int(np.bitwise_xor.reduce(np.frombuffer(bytes(blank), np.uint8))) & 0x0F
        assert ends.receive(frame) == status.FRAME_VALID


CRCS = [kind for kind in crccheck.crc.ALLCRCCLASSES if 3 <= kind._width <= 64]


@pytest.mark.parametrize("big_endian", [False, True])
def test_every_crc_of_the_catalogue(tmp_path, big_endian):
    rng = np.random.default_rng(SEED)
    assert len(CRCS) > 80
    for number, kind in enumerate(CRCS):
        width, folder = kind._width, tmp_path / str(number)
        folder.mkdir()
        start = 64 + 7 if big_endian else 64
        check = Sig("Check", start, width, big_endian=big_endian)
        ends = counted(
            Protection(checksum="Check", algorithm=kind._names[0], own_bits="zero"), [check], folder, length=16, where=2
        )
        frame = ends.send(float(rng.uniform(-1, 1)))
        blank = bytearray(frame[:8]) + bytes(8)
        told = (
            int.from_bytes(frame[8:16], "big") >> (64 - width) if big_endian else int.from_bytes(frame[8:16], "little")
        )
        assert told == kind.calc(bytes(blank)), kind._names
        assert ends.receive(frame) == status.FRAME_VALID


@pytest.mark.parametrize("name, same", [
    ("CRC-8/SAE-J1850", "crc8saej1850"), ("crc-ccitt-false", "CRC-16/IBM-3740"), ("modbus", "CRC-16/MODBUS"), ("crc-32c", "CRC-32/ISCSI"),
    ("j1850", "Crc8SaeJ1850"), ("CRC-16/CCITT-FALSE", "CRC-16/AUTOSAR"), ("crc-32", "CRC-32/ISO-HDLC"),
])  # fmt: skip
def test_crcs_by_their_names(name, same):
    assert named_crc("x", name) == named_crc("x", same)


def test_a_crc_by_its_parameters(tmp_path):
    words = {"polynomial": 0x2F, "start": 0xFF, "final_xor": 0xFF}
    ends = counted(
        Protection(counter="Alive", checksum="Check", data_id_list=list(range(16)), **words),
        [COUNTER, SUM8],
        tmp_path,
        where=2,
    )
    for number in range(20):
        frame = ends.send()
        assert frame[7] == crccheck.crc.Crc8Autosar.calc(bytes(frame[:7]) + bytes([number % 16]))
        assert ends.receive(frame) == status.FRAME_VALID


@pytest.mark.parametrize("extended", [True, False])
def test_j1939_message_counter_and_checksum(tmp_path, extended):
    can_id = 0x0C000003 if extended else 0x103
    ends = Ends(tmp_path, Protection(profile="J1939"), where=2, can_id=can_id, extended=extended)
    for number in range(20):
        frame = ends.send(number / 50)
        counter = frame[7] & 0x0F
        total = sum(frame[:7]) + counter + sum((can_id + 1).to_bytes(4, "big"))
        assert counter == number % 8
        assert frame[7] >> 4 == (((total >> 6) & 3) + (total >> 3) + total) & 7
        theirs = bytearray(frame)  # the same frame from the firmware, under its own identifier
        total += sum(can_id.to_bytes(4, "big")) - sum((can_id + 1).to_bytes(4, "big"))
        theirs[7] = counter | ((((total >> 6) & 3) + (total >> 3) + total) & 7) << 4
        assert ends.receive(theirs) == status.FRAME_VALID


OWN = '''
"""Counter 0..10 in byte 0, a weighted sum in the last byte."""
MODULUS = 11
WEIGHTS = (3, 3)


def total_of(data, length):
    total = 0
    for index in range(length - 1):
        total = (total * WEIGHTS[index % 2] + int(data[index])) & 0xFF
    return total


def check(data, length, counter, sent):
    if sent:
        data[0] = (counter + 1) % MODULUS
        data[length - 1] = total_of(data, length)
        return (counter + 1) % MODULUS
    if data[length - 1] != total_of(data, length):
        return -1
    if data[0] == counter:
        return -2
    return data[0]
'''


def test_a_function_of_the_users_own(tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    ends = Ends(tmp_path, "mine.py:check", where=2)
    for number in range(30):
        frame = ends.send(number / 50)
        total = 0
        for byte in frame[:7]:
            total = (total * 3 + byte) & 0xFF
        assert frame[0] == number % 11 and frame[7] == total
        assert ends.receive(frame) == status.FRAME_VALID and ends.receive(frame) == status.FRAME_REPEATED_COUNTER
        frame[3] ^= 1
        assert ends.receive(frame) == status.FRAME_BAD_CRC
    assert ends.receiver.fresh[0]["valve_command"] == pytest.approx(number / 50, abs=1e-4)


@pytest.mark.parametrize("text, found", [
    (None, "cannot be read"), ("def check(:", "is no Python file"), ("x = 1", "defines no function 'check'"),
    ("def check(data, length, counter, sent):\n    raise ValueError", "line 2: raise cannot run inside a period"),
    ("1 / 0\ndef check(data, length, counter, sent):\n    return 0", "line 1: is neither a function nor a constant"),
    ("import os\ndef check(data, length, counter, sent):\n    return 0", "line 1: is neither a function nor a constant"),
    ("def check(data, length, counter, sent):\n    return open(counter)", "line 2: calls something"),
    ("def check(data, length, counter, sent):\n    return data.ctypes", "line 2: reaches into an object"),
    ("def check(data, length, counter, sent):\n    return check(data, length, counter, sent)", "line 2: calls something"),
    ("@range\ndef check(data, length, counter, sent):\n    return 0", "has a decorator"),
    ("def check(data, length, counter, sent):\n    while True:\n        pass", "line 2: while cannot run"),
    ("def check(data):\n    return 0", "cannot be compiled"),
])  # fmt: skip
def test_functions_that_cannot_be_used(tmp_path, text, found):
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    if found == "cannot be compiled" and codec_entries.encode.protection.config.DISABLE_JIT:
        return
    with pytest.raises(DbcError) as error:
        Ends(tmp_path, "mine.py:check", where=2)
    assert found in str(error.value)


@pytest.mark.parametrize("protection, found", [
    ("crc", "protection 'crc' is not known"),
    (Protection(profile="P01"), "P01: no data_id"),
    (Protection(profile="P01", data_id=1 << 16), "0..65535"),
    (Protection(profile="P07", data_id=1), "8 bytes cannot hold P07"),
    (Protection(profile="P11", data_id=1, data_id_mode="low"), "P11 knows no data_id_mode 'low'"),
    (Protection(), "neither `counter` nor `checksum`"),
    (Protection(counter="Nope"), "no signal 'Nope'"),
    (Protection(counter="Alive", counter_modulus=17), "does not fit Alive, 4 bits"),
    (Protection(checksum="Check", algorithm="CRC-16/ARC"), "has 16 bits, Check has 8"),
    (Protection(checksum="Check", algorithm="crc-8/saej1851"), "no checksum is called"),
    (Protection(checksum="Check", first_byte=5, last_byte=3), "are not those of the message"),
    (Protection(checksum="Check", data_id_list=[1]), "16 numbers"),
    (Protection(checksum="Alive", own_bits="skipped"), "does not fill whole bytes"),
    (Protection(profile="P05", data_id=1, offset_bytes=5), "share bits"),
])  # fmt: skip
def test_protections_that_do_not_fit(tmp_path, protection, found):
    with pytest.raises(DbcError) as error:
        counted(protection, [COUNTER, SUM8], tmp_path, where=6 if "share" in found else 2)
    assert found in str(error.value)


def test_a_database_may_declare_other_profiles(tmp_path):
    path = write(
        tmp_path,
        [
            Msg(
                "CMD",
                1,
                8,
                [Sig("Valve", 32, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%")],
                data_ids="1",
                profile="P05",
            )
        ],
    )
    path.write_text(
        path.read_text()
        + 'BA_DEF_ BO_ "E2EDataId" INT 0 65535;\nBA_DEF_DEF_ "E2EDataId" 0;\nBA_ "E2EDataId" BO_ 1 2615;\n'
    )
    table, _ = signals.load_signals(
        path, [AxisMapping(CommandMapping("CMD", valve_command=SignalMapping("Valve")), [])]
    )
    frame = bytearray(8)
    e2e.p05.e2e_p05_protect(frame, 2615, length=8, increment_counter=False)
    receiver = decode.new_receiver(table, 1)
    assert codec_entries.decode_with(table, 1, 8, codec_entries.padded(bytes(frame)), 0, receiver) == (
        0,
        status.FRAME_VALID,
    )
