"""How a module of this package is started as a process of its own: what lies in the working folder must not be imported by it.

`python -m` looks for modules in the working folder first, and an empty entry of PYTHONPATH means the same: a file signal.py or can.py
that somebody keeps there would be run in the place of the library of that name.
"""

import os
import site
import sys
from pathlib import Path

import hilrunner


def module_command(module: str) -> list[str]:
    """The interpreter's words that run a module, with the working folder left out of the search path."""
    return [sys.executable, "-P", "-m", module]


def code_command(code: str, *words: str) -> list[str]:
    """The same for a line of code, with words in sys.argv[1:]."""
    return [sys.executable, "-P", "-c", code, *words]


def environment(**changes: str) -> dict[str, str]:
    """The environment for such a process: this package is found where it is now, and PYTHONPATH has no empty entry."""
    root = str(Path(hilrunner.__file__).resolve().parent.parent)
    installed = {os.path.realpath(folder) for folder in (*site.getsitepackages(), site.getusersitepackages())}
    # an installed package is found without help, and its folder must not come before the standard library's
    first = [] if root in installed else [root]
    entries = first + [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(entries)), **changes}
