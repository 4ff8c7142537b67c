"""tools/vcan_lab gives a command a real vcan0 and otherwise stays out of its way: files, folder, environment, output, exit code, signals."""

import json
import os
import signal
import subprocess
import sys
import time

from hilrunner.labs.words import EXIT_TIMEOUT
from tests.rules import tree

LAB = tree.ROOT / "tools" / "vcan_lab"
PROBE = """
import json, os, socket, subprocess, sys, time
from multiprocessing import shared_memory
from pathlib import Path
found = {
    "cwd": os.getcwd(), "word": os.environ["LAB_TEST_WORD"], "lab": os.environ["HILRUNNER_CAN_LAB"], "arguments": sys.argv[1:],
    "stdin": sys.stdin.read(), "umask": os.umask(0),
    "mtu": [int(Path(f"/sys/class/net/{name}/mtu").read_text()) for name in ("vcan0", "vcan1")],
}
block = shared_memory.SharedMemory(create=True, size=1 << 20)
reader = "import sys; print(open('/dev/shm/' + sys.argv[1], 'rb').read(3).decode())"
block.buf[:3] = b"abc"
found["shared"] = subprocess.run([sys.executable, "-c", reader, block.name], capture_output=True, text=True).stdout.strip()
block.close()
block.unlink()
send, receive = (socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) for _ in range(2))
send.bind(("vcan0",))
receive.bind(("vcan0",))
send.send(bytes.fromhex("00020000 08000000 0102030405060708"))
found["frame"] = receive.recv(16).hex()
Path("written").write_text(json.dumps(found))
print("first", flush=True)
print("to the error output", file=sys.stderr, flush=True)
time.sleep(1.5)
sys.stdout.buffer.write(b"\\x00\\r\\n\\xff" * 20000)
sys.exit(23)
"""


def _start(folder, *command, options=()):
    return subprocess.Popen(
        [sys.executable, LAB, "--timeout", "120", *options, "--", *command],
        cwd=folder,
        env=dict(os.environ, LAB_TEST_WORD="a 'quoted' word"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a parent in the background has it ignored
    )


def test_a_command_runs_as_if_at_home_but_with_a_bus(tmp_path):
    folder = tmp_path / "a folder"
    folder.mkdir()
    (folder / "probe.py").write_text(PROBE)
    lab = _start(folder, sys.executable, "probe.py", "two words", "$HOME")
    first = lab.stdout.readline()
    first_at_s = time.monotonic()
    rest = lab.stdout.read()
    rest_at_s = time.monotonic()
    errors = lab.stderr.read().decode()
    assert lab.wait() == 23, errors
    assert first == b"first\n"
    assert rest_at_s - first_at_s > 1.0, "output is to come as it is written, not at the end"
    assert rest == b"\x00\r\n\xff" * 20000
    assert errors.splitlines()[-1] == "to the error output"
    found = json.loads((folder / "written").read_text())
    assert found["cwd"] == str(folder)
    assert found["word"] == "a 'quoted' word"
    assert found["arguments"] == ["two words", "$HOME"]
    assert found["stdin"] == ""
    assert found["mtu"] == [72, 72]
    assert found["shared"] == "abc"
    assert found["frame"] == "0002000008000000" + "0102030405060708"
    mask = os.umask(0)
    os.umask(mask)
    assert found["umask"] == mask


def test_an_interrupt_reaches_the_command(tmp_path):
    program = "import time\ntry:\n  print('on', flush=True); time.sleep(60)\nexcept KeyboardInterrupt:\n  print('clean end'); raise SystemExit(7)"
    lab = _start(tmp_path, sys.executable, "-c", program)
    assert lab.stdout.readline() == b"on\n"
    lab.send_signal(signal.SIGINT)
    assert lab.stdout.read() == b"clean end\n"
    assert lab.wait() == 7


def test_a_command_that_does_not_end_is_ended():
    lab = subprocess.run(
        [sys.executable, LAB, "--timeout", "15", "--quiet", "sleep", "300"], capture_output=True, text=True
    )
    assert lab.returncode == EXIT_TIMEOUT
    assert "--timeout" in lab.stderr
