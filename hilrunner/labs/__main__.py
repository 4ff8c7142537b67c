"""`python -m hilrunner.labs`, and this file by its path: for interpreters that have neither hilrunner nor what it needs."""

import sys
from pathlib import Path

if not __package__:
    sys.path[0] = str(Path(__file__).resolve().parents[2])

from hilrunner.labs.command import main

if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
