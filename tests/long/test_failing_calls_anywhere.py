"""Drawn system calls of a run fail at drawn places, once or for good, in the runner or in its recorder: one documented end each time."""

import errno
import tempfile
from pathlib import Path

import pytest
from test_failing_calls import run

from hilrunner.base import exit_codes
from tests.tools import socket_bench
from tools import failing_calls

COUNT = 40
ERRNOS = (errno.EINTR, errno.EIO, errno.EINVAL, errno.ENOMEM, errno.EAGAIN, errno.ENOSPC)
CALLS_OF_A_RUN = 3000  # of the most frequent call, about


@pytest.mark.timeout(7200)
def test_every_failing_call_has_a_documented_end(tmp_path, drawn):
    documented = {value for name, value in vars(exit_codes).items() if name.isupper() and isinstance(value, int)} | {
        130
    }
    with tempfile.TemporaryDirectory() as place:
        library = failing_calls.build(Path(place))
        for index in range(COUNT):
            folder = tmp_path / str(index)
            folder.mkdir()
            in_recorder = bool(drawn.integers(0, 2))
            call = str(drawn.choice(failing_calls.RECORDER_CALLS if in_recorder else failing_calls.LOOP_CALLS))
            code, count = int(drawn.choice(ERRNOS)), int(drawn.choice([1, 5, -1]))
            if in_recorder and code == errno.EINTR:
                count = max(count, 1)  # Python itself takes an interrupted call up again, for ever
            first = int(drawn.integers(1, CALLS_OF_A_RUN))
            environment = failing_calls.environment(
                library, call, code, first, count,
                process=failing_calls.RECORDER if in_recorder else "socket_bench",
                thread="any" if in_recorder else "other",
            )  # fmt: skip
            told = f"trial {index}: {environment}"
            print(told)
            try:
                found, summary, said = run(folder, environment, 2.0)
            except AssertionError as refused:  # before the first tick: one line
                assert "Traceback" not in str(refused) and "hilrunner" in str(refused), (told, refused)
                continue
            assert found in documented and summary["exit_reason"], told
            assert "Traceback" not in said, (told, said)


assert socket_bench.END_LIMIT_S <= 120.0, "what takes longer hangs"
