"""A crash of the runner under a real systemd, in the kernel of the lab: the recorder finishes the log.

Needs Debian's package systemd, which need not be what the machine has booted with.
"""

import json
import os
import subprocess
import sys

import pytest

from tests.long import systemd_in_lab
from tests.rules import tree


@pytest.mark.parametrize("mode", ["shipped", "mixed"])
def test_the_recorder_outlives_a_crash_as_shipped_and_not_with_mixed(tmp_path, mode):
    if not os.path.exists(systemd_in_lab.MANAGER):
        pytest.fail(f"no {systemd_in_lab.MANAGER}; apt-get install --no-install-recommends systemd", pytrace=False)
    lab = [sys.executable, tree.ROOT / "tools" / "vcan_lab", "--lab", "uml", "--timeout", "1200", "--"]
    done = subprocess.run(
        [*lab, sys.executable, systemd_in_lab.__file__, tmp_path, mode], capture_output=True, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tree.ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {"damaged": mode == "mixed"}
