"""The checker of the tests sees damage: one flipped byte anywhere is found."""

import mcap_doctor
import numpy as np
from recorder_producer import START_MONO_NS, START_REAL_NS, periods

from hilrunner.record.mcap_log import LogWriter


def test_every_flipped_byte_is_noticed(tmp_path):
    path = tmp_path / "a.mcap"
    log = LogWriter(path, ["boom"], metadata={"run": {"a": "b"}}, attachments=[("n", "text/plain", b"data")])
    for first in (0, 50):
        tick, command, state, can = periods(first, 50, 1, 1_000_000)
        log.write_ticks(tick, command, state, START_MONO_NS, START_REAL_NS)
        log.write_can(can, START_MONO_NS, START_REAL_NS)
        log.flush()
    log.close()
    assert mcap_doctor.examine(path).faults == []
    sound = path.read_bytes()
    rng = np.random.default_rng(7)
    for place in rng.choice(len(sound), 150, replace=False):
        damaged = bytearray(sound)
        damaged[place] ^= 1 << rng.integers(8)
        (tmp_path / "b.mcap").write_bytes(damaged)
        try:
            faults = mcap_doctor.examine(tmp_path / "b.mcap").faults
        except Exception as error:  # lengths that lead nowhere end in many ways; all are findings
            faults = [repr(error)]
        assert faults, f"byte {place} of {len(sound)} flipped unnoticed"
