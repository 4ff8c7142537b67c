"""Recorded CAN logs of other people's tools: every form gives the same frames at the same exact times, and no damage passes unseen."""

import gzip
import struct
import zlib

import can
import pytest

from hilrunner.base.errors import UsageError
from hilrunner.setup import can_frame
from hilrunner.setup.can_log import kind_of_log, read_can_log
from hilrunner.setup.text import Contents, read_contents

MS = 1_000_000


def read(folder, name, data):
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    contents = read_contents(path, UsageError)
    return read_can_log(path, kind_of_log(path, contents), contents)


def steps_ns(log):
    return [time_ns - log.time_ns[0] for time_ns in log.time_ns]


FRAMES = [can_frame.pack_classic(0x64, 2, b"\x01\x02"), can_frame.pack_classic(0x98FF1234, 8, bytes(range(8)))]
LOGGED = "(1764300000.000001) can0 064#0102\n(1764300000.001001) can0 18FF1234#0001020304050607\n"
ON_SCREEN = "  can0  064   [2]  01 02\n  can0  18FF1234   [8]  00 01 02 03 04 05 06 07   '........'\n"


def stamped(*stamps):
    return "".join(f" ({stamp}){line}\n" for stamp, line in zip(stamps, ON_SCREEN.splitlines(), strict=True))


ASC = """date Don Dez 4 10:44:52.480 2025
base {base}  timestamps {stamps}
internal events logged
// Prüfstand
Begin Triggerblock Don Dez 4 10:44:52.480 2025
   0.000000 Start of measurement
   {t0} 1  {a}              Rx   d 2 01 02
   {t1} 1  {b}x       Rx   d 8 00 01 02 03 04 05 06 07  Length = 0 BitCount = 0
End TriggerBlock
"""
ABSOLUTE = ASC.format(base="hex", stamps="absolute", a="64", b="18FF1234", t0="0.500000", t1="0.501000")
DECIMAL = ASC.format(base="dec", stamps="absolute", a="100", b=str(0x18FF1234), t0="0.500000", t1="0.501000")
RELATIVE = ASC.format(base="hex", stamps="relative", a="64", b="18FF1234", t0="0.500000", t1="0.001000")
PYTHON_CAN = """timestamp,arbitration_id,extended,remote,error,dlc,data
1764300000.000001,0x64,0,0,0,2,AQI=
1764300000.001001,0x18ff1234,1,0,0,8,AAECAwQFBgc=
"""
SAVVYCAN = """Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
1000,00000064,false,Rx,0,2,01,02,,,,,,
2000,18FF1234,true,Rx,0,8,00,01,02,03,04,05,06,07,
"""
TRC_11 = """;$FILEVERSION=1.1
;$STARTTIME=45995.4478
;   Prüfstand
     1)         1.0  Rx         0064  2  01 02
     2)         2.0  Rx     18FF1234  8  00 01 02 03 04 05 06 07
"""
TRC_21 = """;$FILEVERSION=2.1
;$STARTTIME=45995.4478123456
;$COLUMNS=N,O,T,B,I,d,R,L,D
      1       1.000 DT 1      0064 Rx -  2    01 02
      2       2.000 DT 1  18FF1234 Rx -  8    00 01 02 03 04 05 06 07
"""


FORMS = [
    ("a.log", LOGGED),
    ("A.LOG", LOGGED.replace("\n", " R\r\n")),
    ("a.log", b"\xef\xbb\xbf" + LOGGED.encode()),
    ("a.txt", LOGGED.encode("utf-16")),
    ("a.log.gz", gzip.compress(LOGGED.encode())),
    ("a.log", stamped("1764300000.000001", "1764300000.001001")),
    ("a.txt", stamped("2025-12-04 10:00:00.000000", "2025-12-04 10:00:00.001000")),
    ("a.log", stamped("000.000000", "000.001000")),
    ("a.log", stamped("0.0", "0.001").replace("can0 ", "\x1b[31mcan0\x1b[0m  RX - -")),
    ("a.asc", ABSOLUTE.encode("cp1252")),
    ("a.asc", DECIMAL),
    ("a.ASC", RELATIVE),
    ("a.asc.gz", gzip.compress(RELATIVE.encode("cp1252"))),
    ("a.asc", "\n".join(ABSOLUTE.splitlines()[6:8])),
    ("renamed.log", ABSOLUTE),
    ("a.csv", PYTHON_CAN),
    ("a.csv", PYTHON_CAN.replace(",", ";").replace(".", ",").replace("\n", "\r\n")),
    ("a.csv.gz", gzip.compress(SAVVYCAN.encode())),
    ("a.trc", TRC_11.encode("cp1252")),
    ("a.trc", TRC_21.replace("\n", "\r\n")),
]


@pytest.mark.parametrize(("name", "data"), FORMS, ids=range(len(FORMS)))
def test_every_form_gives_the_same_frames(tmp_path, name, data):
    log = read(tmp_path, name, data)
    assert log.packet == FRAMES
    assert steps_ns(log) == [0, MS]
    assert log.cut == "" and log.other_lines == 0 and len(set(log.channel)) == 1


def test_other_kinds_of_frames_of_candump(tmp_path):
    log = read(tmp_path, "a.log", """\
(0.000000) can0 064##3AABBCCDDEEFF00112233
(0.001000) can0 064#R4
(0.002000) vcan1 20000004#0004000000000000
(0.003000) can0 064#
(0.004000) can0 064#0011223344556677_F
""")  # fmt: skip
    assert [len(packet) for packet in log.packet] == [72, 16, 16, 16, 16]
    assert log.packet[0][4:6] == bytes([10, can_frame.FDF | 3])
    assert int.from_bytes(log.packet[1][:4], "little") & can_frame.RTR and log.packet[1][4] == 4
    assert int.from_bytes(log.packet[2][:4], "little") == 0x20000004
    assert log.channel[2] == "vcan1" and log.packet[4][4] == 8


def test_stamps_are_exact_however_large_they_are(tmp_path):
    rows = "".join(f"(1764300000.{k:09d}) can0 064#00\n" for k in range(0, 1000, 7))
    assert steps_ns(read(tmp_path, "a.log", rows)) == list(range(0, 1000, 7))
    rows = "".join(f"{1764300000 + k * 1e-3!r},0x64,0,0,0,1,AA==\n" for k in range(2000))
    log = read(tmp_path, "a.csv", PYTHON_CAN.splitlines()[0] + "\n" + rows)
    assert steps_ns(log) == [k * MS for k in range(2000)]


def test_relative_stamps_count_from_the_line_before_of_any_kind(tmp_path):
    rows = [
        "base hex timestamps relative",
        "0.250000 1 64 Rx d 1 00",
        "0.250000 1 Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 0.10%",
        "0.250000 1 64 TxRq d 1 01",
        "0.250000 1 64 Rx d 1 02",
    ]
    log = read(tmp_path, "a.asc", "\n".join(rows) + "\n")
    assert steps_ns(log) == [0, 750 * MS] and log.stamps == "relative" and log.other_lines == 2


def test_differences_of_candump_become_times(tmp_path):
    line = "  can0  064   [1]  00"
    stamps = ["000.000000", "000.500000", "000.250000", "000.500000"]
    log = read(tmp_path, "a.log", "".join(f" ({one}){line}\n" for one in stamps))
    assert steps_ns(log) == [0, 500 * MS, 750 * MS, 1250 * MS] and "-td" in log.stamps
    with pytest.raises(UsageError, match="may be times .* or differences"):
        read(tmp_path, "a.log", "".join(f" ({one}){line}\n" for one in ["000.000000", "000.500000", "000.500000"]))


CUT_ENDS = [
    ("a.log", LOGGED + "(1764300000.00"),
    ("a.log", LOGGED + "(1764300000.003000) can0 064#010"),
    ("a.txt", stamped("0.000000", "0.001000") + " (0.002000)  can0  064   [2]  01"),
    ("a.asc", "\n".join(ABSOLUTE.splitlines()[:8]) + "\n   0.600000 1  64 "),
    ("a.asc", "\n".join(ABSOLUTE.splitlines()[:8]) + "\n   0.600000 1  64  Rx   d 2 01"),
    ("a.asc", "\n".join(ABSOLUTE.splitlines()[:8]) + "\n   0.600000 1  64  Rx   d 2 01 0"),
    ("a.asc", "\n".join(ABSOLUTE.splitlines()[:8]) + "\n   0.6"),
    ("a.trc", TRC_11 + "     3)         3.0  Rx         0064  2  01"),
    ("a.trc", TRC_11 + "     3)         3.0  Rx         0064  2  01 0"),
    ("a.trc", TRC_11 + "     3)   "),
    ("a.trc", TRC_21 + "      3       3.000 DT 1      0064 Rx -  2    01"),
    ("a.csv", PYTHON_CAN + "1764300000.002001,0x64,0,0,0,2,AQ"),
    ("a.csv", PYTHON_CAN + "1764300000.00"),
    ("a.csv", SAVVYCAN + "3000,00000064,false,Rx,0,2,01"),
    ("a.log", LOGGED.encode() + bytes(4096)),
    ("a.log.gz", gzip.compress(LOGGED.encode() + bytes(range(48, 120)) * 4)[:-9]),
]


@pytest.mark.parametrize(("name", "data"), CUT_ENDS, ids=range(len(CUT_ENDS)))
def test_an_end_that_was_cut_is_left_out_and_told(tmp_path, name, data):
    log = read(tmp_path, name, data)
    assert log.packet == FRAMES and log.cut


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.log", ON_SCREEN, "line 1: .*no time stamp.*candump -L"),
        ("a.log", LOGGED + "(1764300000.00\n" + LOGGED, "line 3: .*not a line of candump"),
        ("a.log", LOGGED + "(later) can0 064#00\n" + LOGGED, "line 3: .*not a number of seconds"),
        ("a.log", LOGGED + "(3.0) can0 064#0102030405060708AA\n", "line 3: .*9 data bytes, at most 8"),
        ("a.log", LOGGED + "(3.0) can0 64#01\n", "line 3: .*neither 3 nor 8 digits"),
        ("a.log", LOGGED + "(3.0) can0 FFF#01\n", "line 3: .*FFF"),
        ("a.log", "***BUSMASTER Ver 3.2.2***\n", "line 1: .*candump -L"),
        ("a.asc", ABSOLUTE.replace("d 2 01 02", "d 2 01 Z2"), "line 7: .*Z2"),
        ("a.asc", ABSOLUTE.replace("d 2 01 02", "d 2 01"), "line 7: .*1 of 2 data bytes"),
        ("a.trc", TRC_11.replace("2  01 02", "2  01"), "line 4: .*not a frame"),
        ("a.trc", TRC_11.replace("=1.1", "=1.2"), "version 1.2"),
        ("a.csv", PYTHON_CAN.replace("AQI=", "AQ=="), "row 2: .*1 of 2 data bytes"),
        ("a.csv", PYTHON_CAN.replace("0x64,0", "0x64,x"), "row 2: .*neither 0 nor 1"),
        ("a.csv", SAVVYCAN.replace("2,01,02", "2,01,"), "row 2: .*1 of 2 data bytes"),
        ("a.log", "", "holds no frames"),
        ("a.log", "# nothing\n\n", "holds no frames"),
        ("a.asc", "date x\nbase hex timestamps absolute\n// nothing\n", "holds no frames"),
        ("a.trc", ";$FILEVERSION=1.1\n", "holds no frames"),
        ("a.csv", PYTHON_CAN.splitlines()[0], "holds no frames"),
        ("a.mf4", b"MDF     4.10" + bytes(100), "a.mf4"),
    ],
)
def test_damage_before_the_end_is_refused_with_its_place(tmp_path, name, data, told):
    with pytest.raises(UsageError, match=told) as refused:
        read(tmp_path, name, data)
    assert "a." in str(refused.value) and "remedy" in str(refused.value)


@pytest.fixture
def blf(tmp_path):
    """The bytes of a BLF file of 3000 frames, one a millisecond, in several containers, as python-can writes it."""
    path = tmp_path / "whole.blf"
    writer = can.BLFWriter(path)
    writer.max_container_size = 20_000
    for k in range(3000):
        writer.on_message_received(
            can.Message(timestamp=1764300000 + k * 1e-3, arbitration_id=0x64, data=k.to_bytes(2, "big"), channel=1,
                        is_extended_id=False)
        )  # fmt: skip
    writer.stop()
    return path.read_bytes()


def test_a_whole_blf(tmp_path, blf):
    for name, data in (("a.blf", blf), ("a.BLF.gz", gzip.compress(blf))):
        log = read(tmp_path, name, data)
        assert log.cut == "" and set(log.channel) == {"2"} and log.other_lines == 0
        assert [packet[8:10] for packet in log.packet] == [k.to_bytes(2, "big") for k in range(3000)]
        assert steps_ns(log) == [k * MS for k in range(3000)]  # python-can's writer had them from floats


@pytest.mark.parametrize("share", [0.3, 0.6, 0.99])
def test_a_cut_blf_is_told(tmp_path, blf, share):
    log = read(tmp_path, "a.blf", blf[: int(len(blf) * share)])
    assert f"{int(len(blf) * share)} of {len(blf)} bytes" in log.cut
    assert 0.2 * share * 3000 < len(log.packet) < 3000


def test_a_blf_whose_recorder_was_killed_has_no_size_in_its_header(tmp_path, blf):
    log = read(tmp_path, "a.blf", blf[:16] + bytes(16) + blf[32 : len(blf) // 2])
    assert "its last container" in log.cut and log.packet


def container(objects: bytes) -> bytes:
    """A BLF file with one stored container around these bytes."""
    head = struct.pack("<4sL8BQQLL8H8H", b"LOGG", 144, *bytes(8), 0, 0, 0, 0, *bytes(16)).ljust(144, b"\0")
    packed = zlib.compress(objects)
    body = struct.pack("<H6xL4x", 2, len(objects)) + packed
    return head + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(body), 10) + body


@pytest.mark.parametrize(
    ("objects", "told"),
    [
        (
            struct.pack("<4sHHLL", b"LOBJ", 32, 1, 0, 1) + bytes(64),
            "an object of 0 bytes",
        ),  # python-can never leaves it
        (bytes(64), "no object begins here"),
        (b"", "holds no frames"),
    ],
)
def test_a_blf_with_broken_objects_is_refused(tmp_path, objects, told):
    with pytest.raises(UsageError, match=told):
        read(tmp_path, "a.blf", container(objects))


def test_damage_inside_a_blf_is_refused(tmp_path, blf):
    for place in (150, 400, len(blf) // 2):
        damaged = blf[:place] + bytes(8) + blf[place + 8 :]
        with pytest.raises(UsageError, match="a.blf"):
            read(tmp_path, "a.blf", damaged)


def test_the_contents_choose_the_reader(tmp_path):
    kinds = {
        "a.csv": (b"time_s,valve_command\n0,0\n", ""),
        "b.csv": (SAVVYCAN.encode(), ".csv"),
        "c.toml": (b"date x = 1", ""),
        "d.dat": (b"LOGG" + bytes(200), ".blf"),
        "e": (LOGGED.encode(), ".log"),
        "f.log": (b"LOGG" + bytes(200), ".blf"),
        "g.asc.gz": (b"hello", ".asc"),
    }
    for name, (data, kind) in kinds.items():
        assert kind_of_log(tmp_path / name, Contents(data)) == kind, name
