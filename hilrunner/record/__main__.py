"""`python -m hilrunner.record`: started by the runner, see launch.py."""

import os
import sys

from hilrunner.record.process import main

code = main()
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)  # the log is closed: nothing that still hangs (a viewer that does not read) may keep the runner waiting
