"""User-Mode Linux on a processor with a large register state (AMX), played on every machine by an object preloaded below the mend."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from hilrunner.labs import preload, uml
from hilrunner.labs.words import EXIT_NO_LAB
from tests.rules import tree

PLAYED_HOST = tree.ROOT / "tests" / "tools" / "large_register_state.c"
# a lab whose kernel gets the objects named, and nothing else of the lab changed
LAB = """
import sys
from hilrunner.labs import command, uml
objects = sys.argv.pop(1)
uml.preloaded = lambda folder: ({"LD_PRELOAD": objects}, "")
sys.exit(command.main(["--lab", "uml", "--timeout", "200", "--", *sys.argv[1:]]))
"""
# two processes take turns while their vector registers are in use; what the guest sees of the variable is printed
GUEST = """
import math, os, subprocess, sys
if len(sys.argv) == 1:
    children = [subprocess.Popen([sys.executable, __file__, str(n)], stdout=subprocess.PIPE) for n in (1, 2)]
    print(*[child.communicate()[0].decode().strip() for child in children])
    print([name for name in os.environ if "PRELOAD" in name], "PRELOAD" in open("/proc/1/environ").read())
else:
    value = float(sys.argv[1])
    for step in range(20000):
        value = math.sqrt(value * value + 1e-3)
        if step % 200 == 0:
            os.sched_yield()
    print(value.hex())
"""


def value(start: float) -> str:
    """What the guest's processes compute."""
    import math

    for _ in range(20000):
        start = math.sqrt(start * start + 1e-3)
    return start.hex()


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """The mend as the lab builds it, and the host that is played."""
    played = tmp_path_factory.mktemp("host") / "large_register_state.so"
    subprocess.run(["cc", *preload.COMPILE, "-Werror", "-o", played, PLAYED_HOST, "-ldl"], check=True)
    return preload.register_state_mend(), played


def boot(folder, preloaded):
    program = folder / "guest.py"
    program.write_text(GUEST)
    words = [sys.executable, "-c", LAB, ":".join(map(str, preloaded)), sys.executable, str(program)]
    return subprocess.run(words, capture_output=True, text=True, cwd=tree.ROOT)


if platform.machine() in uml.MACHINES:

    def test_without_the_mend_it_cannot_start_and_says_so_in_one_line(objects, tmp_path):
        done = boot(tmp_path, objects[1:])
        assert done.returncode == EXIT_NO_LAB and done.stdout == "", done
        first, last = done.stderr.splitlines()
        assert first.startswith("lab: no User-Mode Linux: its kernel cannot write back this processor's registers")
        assert last.startswith("lab: no lab could start")

    @pytest.mark.parametrize("host", ["large state", "this one"])
    def test_with_the_mend_it_starts_and_registers_keep_their_values(objects, tmp_path, host):
        done = boot(tmp_path, objects if host == "large state" else objects[:1])
        assert done.returncode == 0, done
        assert done.stdout.splitlines() == [f"{value(1.0)} {value(2.0)}", "[] False"], "or the variable is in the guest"

    def test_the_lab_preloads_it(tmp_path):
        variables, why_not = uml.preloaded(tmp_path)
        assert why_not == "" and Path(variables["LD_PRELOAD"]).resolve() == preload.register_state_mend()
        assert preload.register_state_mend().parent.stat().st_mode & 0o777 == 0o700

else:

    def test_there_is_no_user_mode_linux_here_and_the_lab_says_so(capfd):
        from hilrunner.labs import command

        assert command.main(["--lab", "uml", "true"]) == EXIT_NO_LAB
        assert platform.machine() in capfd.readouterr().err.splitlines()[0]
