"""`python -m hilrunner` is `hilrunner`."""

import os
import sys

# `python -m` puts the working folder first: a file signal.py or can.py that somebody keeps there is not ours to run
if not sys.flags.safe_path and sys.path and os.path.realpath(sys.path[0] or os.curdir) == os.path.realpath(os.curdir):
    del sys.path[0]

from hilrunner.cli import main

raise SystemExit(main())
