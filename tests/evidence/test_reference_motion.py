"""A reference motion from a spreadsheet: any of the usual delimiters and encodings, each bad row named by its line."""

from types import SimpleNamespace

import numpy as np
import pytest

from hilrunner.base.errors import LogError
from hilrunner.evidence.report import read_reference

RUN = SimpleNamespace(axis_names=["boom", "jib"])


@pytest.mark.parametrize(
    "data",
    [
        b"time_s,boom_mm,jib_mm\n0,100,1.5\n0.5,200,2\n",
        b"\xef\xbb\xbftime_s;boom_mm;jib_mm\r\n0;100;1,5\r\n0,5;200;2\r\n",
        "# Prüfstand\ntime_s\tboom_mm\tjib_mm\n0\t100\t1,5\n0,5\t200\t2".encode("cp1252"),
        "time_s;boom_mm;jib_mm;;\n0;100;1,5;;\n0,5;200;2;;\n".encode("utf-16"),
    ],
)
def test_every_form_gives_the_same_motion(tmp_path, data):
    path = tmp_path / "motion.csv"
    path.write_bytes(data)
    reference = read_reference(path, RUN)
    np.testing.assert_allclose(reference["boom"], [[0.0, 0.1], [0.5, 0.2]])
    np.testing.assert_allclose(reference["jib"], [[0.0, 0.0015], [0.5, 0.002]])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("time_s,boom_mm\n0,100\n1\n", "row 3: '1' is not 2 numbers"),
        ("time_s,boom_mm\n0,100\n1,x\n", "row 3"),
        ("time_s,boom_mm\n0,100\n1,200,300\n", "row 3"),
        ("time_s,boom_mm\n0,nan\n", "finite"),
        ("time_s,boom_mm\n1,1\n0,2\n", "do not increase"),
        ("time_s,other_mm\n0,1\n", "no column for an axis"),
        ("time_s,boom_mm\n", "no rows"),
        ("", "cannot be read|no rows"),
    ],
)
def test_bad_rows_are_named(tmp_path, text, told):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=told) as refused:
        read_reference(path, RUN)
    assert "motion.csv" in str(refused.value)
