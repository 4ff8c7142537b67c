"""The runner waits for a recorder that works, and gives up one that stands still."""

import subprocess
import sys
import tempfile
import time

from hilrunner.record.launch import RecorderHandle, processor_s

WORKS = "import time\nend = time.monotonic() + 5\nwhile time.monotonic() < end: pass\nprint('{\"tick_count\": 7}')"
STANDS = "import time\ntime.sleep(60)"


def handle(code: str) -> RecorderHandle:
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    return RecorderHandle(process, None, tempfile.TemporaryFile())


def test_one_that_works_is_waited_for_beyond_the_limit():
    recorder = handle(WORKS)
    assert recorder.finish(timeout_s=2.0) == {"tick_count": 7}


def test_one_that_stands_still_is_given_up():
    recorder = handle(STANDS)
    time.sleep(0.5)  # its start takes processor time as well
    assert recorder.finish(timeout_s=1.0)["error"][1] == "did not finish within 1 s"
    assert recorder.process.poll() is not None


def test_a_process_that_is_gone_has_used_nothing():
    assert processor_s(0) == 0.0
    assert processor_s(1 << 22) == 0.0
