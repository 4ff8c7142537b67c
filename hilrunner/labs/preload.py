"""The shared object that lets User-Mode Linux start on processors with a large register state: built once, into a folder of ours."""

import hashlib
import subprocess
import tempfile
from pathlib import Path

from hilrunner.base.errors import FolderError
from hilrunner.base.own_folder import cache_base, own_folder
from hilrunner.labs.words import one_line, which

SOURCE = Path(__file__).with_name("register_state.c")
COMPILE = ["-std=c11", "-O2", "-Wall", "-Wextra", "-shared", "-fPIC"]


class NotBuilt(Exception):  # noqa: N818  (most hosts do without)
    """The mend cannot be built here; its text says why."""


def register_state_mend() -> Path:
    """The shared object to preload, compiled if it is not there yet.

    Raises:
        NotBuilt: no compiler, or no folder of our own to keep it in.
    """
    text = SOURCE.read_bytes()
    name = hashlib.sha256(text + " ".join(COMPILE).encode()).hexdigest()[:16]
    try:
        folder = own_folder(cache_base() / "labs")
    except FolderError as error:
        raise NotBuilt(str(error)) from None
    library = folder / f"register_state-{name}.so"
    if not library.is_file():
        _build(SOURCE, library)
    return library


def _build(source: Path, library: Path) -> None:
    """Compile beside the library's place, then put it there whole: several labs may start at once."""
    compiler = which("cc") or which("gcc")
    if compiler is None:
        raise NotBuilt("there is no C compiler")
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        fresh = Path(folder) / library.name
        done = subprocess.run([compiler, *COMPILE, "-o", fresh, source, "-ldl"], capture_output=True, text=True)
        if done.returncode:
            raise NotBuilt(one_line(f"{compiler}: {done.stderr}"))
        fresh.replace(library)
