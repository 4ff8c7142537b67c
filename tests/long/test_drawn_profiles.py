"""A thousand profiles drawn over every key: each runs, or is refused in one line, and none takes a minute."""

import time
from collections import Counter

from drawn_profiles import Drawing
from profile_trial import LEFT_THE_NUMBERS, RAN, tried

COUNT = 1000
SLOWEST_S = 60.0


def test_a_thousand_drawn_profiles_run_or_are_refused_in_one_line(tmp_path, drawn):
    outcomes: Counter = Counter()
    for wrong in (0.002, 0.02):
        drawing = Drawing(drawn, wrong)
        for number in range(COUNT // 2):
            text = drawing.text()
            begun_s = time.monotonic()
            try:
                outcome, _ = tried(text, tmp_path)
            except Exception as error:
                raise AssertionError(f"profile {number}, share {wrong}:\n{text}") from error
            if outcomes:  # the first one compiles what was not compiled yet
                assert time.monotonic() - begun_s < SLOWEST_S, text
            assert outcome != LEFT_THE_NUMBERS, text
            outcomes[outcome] += 1
    print(dict(outcomes))
    assert outcomes[RAN] > COUNT // 20, outcomes
