"""The host of a run stands still at drawn moments for 1 ms to 10 s, over its start, its end and whatever it does in between."""

import numpy as np
import pytest
from test_stalls import judge, stalled_run

from hilrunner.base import exit_codes

COUNT = 25
SHORTEST_S, LONGEST_S = 1e-3, 10.0
LIMIT_S = 0.1


@pytest.mark.timeout(3600)
def test_no_stall_blames_the_firmware_or_goes_unsaid(tmp_path, drawn):
    for index in range(COUNT):
        folder = tmp_path / str(index)
        folder.mkdir()
        duration_s = float(drawn.uniform(1.0, 3.0))
        stalls = [
            (float(drawn.uniform(0.0, 1.5)), float(np.exp(drawn.uniform(np.log(SHORTEST_S), np.log(LONGEST_S)))))
            for _ in range(int(drawn.integers(1, 4)))
        ]
        start_delay_s = float(drawn.choice([0.02, 0.5]))
        every_s = float(drawn.choice([0.002, 0.005, 0.01]))
        told = f"trial {index}: {duration_s:.2f} s, stalls {stalls}, start after {start_delay_s} s, a frame every {every_s} s"
        print(told)
        found = stalled_run(folder, stalls, duration_s, start_delay_s, every_s=every_s)
        code, summary = found[:2]
        assert summary["exit_reason"] == "duration reached", told
        assert len(found[3].tick) == round(duration_s * 1000), told
        longest_s = summary["stall"]["longest_ms"] * 1e-3
        if longest_s > LIMIT_S:
            judge(*found, min(longest_s, LIMIT_S))
            assert code == exit_codes.BENCH_FAILED, told
        else:
            assert code == exit_codes.PASSED, told


@pytest.mark.timeout(600)
@pytest.mark.parametrize("still_s", [0.15, 1.0, 10.0])
def test_a_firmware_at_full_speed_through_a_stall(tmp_path, still_s):
    """A command every millisecond: 10,000 of them wait after ten seconds, more than the inbox takes at once."""
    found = stalled_run(tmp_path, [(1.0, still_s)], still_s + 2.5, every_s=0.001)
    judge(*found, still_s)
    assert found[0] == exit_codes.BENCH_FAILED and len(found[3].tick) == round((still_s + 2.5) * 1000)
