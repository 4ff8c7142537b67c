"""Schedules from files: as spreadsheets and other tools write them, every row checked, each refusal with its place."""

import numpy as np
import pytest

from hilrunner.base.errors import ProfileError
from hilrunner.plant.schedule import sample
from hilrunner.setup.schedule_file import load_schedule


def written(folder, name, text, encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return str(path)


def test_schedules_from_files(tmp_path):
    table = written(tmp_path, "a.csv", "# by hand\ntime_s,valve_command\n0,0\n1,0.5\n2,-0.25\n3,0\n")
    data = load_schedule(table)
    assert data.duration_s == 3.0
    assert sample(data, np.array([0.5, 1.0, 1.9, 2.0, 9.0])).tolist() == [0.0, 0.5, 0.5, -0.25, 0.0]
    ramps = written(tmp_path, "b.toml", 'kind = "ramps"\nduration_s = 2.0\nramps = [[0.5, 0.1, 0.4]]\n')
    assert sample(load_schedule(ramps), np.array([1.0]))[0] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("time_s,valve_command\r\n0,0\r\n0.5,0.25\r\n1,-1\r\n", "utf-8-sig"),
        ("time_s;valve_command\n0;0\n0,5;0,25\n1;-1\n", "utf-8"),
        ("sep=;\ntime_s;valve_command\n0;0\n0,5;0,25\n1;-1", "cp1252"),
        ("time_s;valve_command;;\n0;0;;\n0,5;0,25;;\n1;-1;;\n;;;\n", "utf-8"),
        ("time_s\tvalve_command\n0\t0\n0.5\t2.5e-1\n1\t-1\n", "utf-16"),
        ('"time_s","valve_command"\n"0","0"\n"0,5","0,25"\n"1","-1"\n', "utf-8"),
        ("# Prüfstand\ntime_s,valve_command\n[s],[-]\n0,0\n0.5,0.25\n\n1,-1\n", "cp1252"),
        ("time_s,valve_command\r0,0\r0.5,.25\r1,-1.\r", "utf-8"),
    ],
)
def test_tables_as_spreadsheets_write_them(tmp_path, text, encoding):
    data = load_schedule(written(tmp_path, "sheet.csv", text, encoding))
    assert (data.times_s, data.commands) == ((0.0, 0.5, 1.0), (0.0, 0.25, -1.0))


MANY = "".join(f"{k / 1000:.3f},0\n" for k in range(5000))
RAMPS = 'kind = "ramps"\nduration_s = 60.0\nramps = [[30.001, 0.0, {0}], [30.002, 0.0, -{0}]]\n'


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("a.csv", "t,u\n0,0\n", "not the header of a schedule: row 1 is 't | u'"),
        ("a.csv", "", "it is empty"),
        ("a.csv", "# nothing\n\n", "it is empty"),
        ("a.csv", "0,0\n1,0.5\n", "row 1 is '0 | 0'"),
        ("a.csv", "time_s,valve_command\n0,0\n1,x\n", "row 3: '1 | x' is not two numbers"),
        ("a.csv", "time_s,valve_command\n0,0\n\n1,1_0\n", "row 4"),
        ("a.csv", "time_s,valve_command\n0,0\n1,\n", "row 3"),
        ("a.csv", "time_s,valve_command\n0,0\n0,5,0,3\n", "row 3: '0 | 5 | 0 | 3' .*semicolons between the columns"),
        ("a.csv", "time_s;valve_command\n0;0\n1.000,5;0\n", "row 3"),
        ("a.csv", "time_s,valve_command\n0,0\n0,1\n1,1\n", "row 3: the times do not increase: 0 s after 0 s"),
        ("a.csv", "time_s,valve_command\n0,0\nnan,1\n1,1\n", "row 3: time_s is nan"),
        ("a.csv", "time_s,valve_command\n-1,0.5\n1,0\n", "row 2: time_s is -1"),
        ("a.csv", "PK\x03\x04", "spreadsheet or a zip archive.*CSV"),
        ("a.csv", "time_s,valve_command\n", "duration_s"),
        ("a.csv", "time_s,valve_command\n0,0\n1,1.5\n", "row 3: commands reach 1.5"),
        ("a.csv", "time_s,valve_command\n0,0\n1,nan\n", "row 3: commands reach nan.*fill the cell"),
        ("a.csv", f"time_s,valve_command\n{MANY}7.0001,70\n7.0002,0\n9,0\n", "row 5002: commands reach 70.*0.7 for 70 %"),
        ("a.csv", "time_s,valve_command\nms,-\n0,0\n1,0\n", "row 2: 'ms | -' are not the units"),
        ("a.csv", "time_s,valve_command\ns,%\n0,0\n1,70\n", "row 2: 's | %' are not the units"),
        ("a.csv", 'time_s,valve_command\n0,"0\n', "not a table"),
        ("a.csv", "\x00\x01\x02\x03", "zero bytes"),
        ("a.toml", 'kind = "ramp"\n', "ramps, table, chirp, random-steps"),
        ("a.toml", 'kind = "chirp"\nduration_s = 1.0\n', "start_hz"),
        ("a.toml", 'kind = "ramps"\nduration_s = 1.0\nramps = [[1, 2]]\n', "wrong form"),
        ("a.toml", 'kind = "ramps"\nduration_s = -1.0\nramps = []\n', "above 0"),
        ("a.toml", 'kind = "ramps"\nduration_s = 1.0\nramps = [[0.5, 0.1, nan]]\n', "not finite"),
        ("a.toml", RAMPS.format(1.5), "commands reach 1.5"),
        ("a.toml", 'kind = "table"\nduration_s = 60.0\ntimes_s = [0, 30, 30.001, 60]\ncommands = [0, 7, 0, 0]\n', r"commands\[1\]"),
        ("a.toml", 'kind = "random-steps"\nduration_s = 1.0\ndwell_s = 0.1\nlow = -2.0\nhigh = 0.5\n', "commands reach -2"),
        ("a.toml", 'kind = "random-steps"\nduration_s = 1.0\ndwell_s = 1e-12\nlow = 0.0\nhigh = 0.5\n', "dwell_s"),
        ("a.toml", 'kind = "chirp"\nduration_s=1.0\nstart_hz=0\nend_hz=1\namplitude=1\n', "above 0 Hz"),
        ("a.toml", 'kind = "chirp"\nduration_s=60.0\nstart_hz=1\nend_hz=200\namplitude=1.01\n', "commands reach -?1.01"),
        ("a.toml", "kind = \n", "not TOML"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_with_their_place(tmp_path, name, text, named):
    path = written(tmp_path, name, text)
    with pytest.raises(ProfileError, match=named) as refused:
        load_schedule(path)
    assert path in str(refused.value)


def test_a_step_that_stays_in_range_is_taken(tmp_path):
    data = load_schedule(written(tmp_path, "a.toml", RAMPS.format(1.0)))
    assert sample(data, np.array([30.0, 30.0015, 30.002])).tolist() == [0.0, 1.0, 0.0]


def test_unknown_schedule_names_the_known_ones():
    with pytest.raises(ProfileError, match="lift-profile"):
        load_schedule("lift-profil")
