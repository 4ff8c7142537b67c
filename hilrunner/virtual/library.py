"""The two C libraries of virtual time, built once from the sources that ship: the bench's side, and what is preloaded into a firmware."""

import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path

from hilrunner.base.errors import UsageError
from hilrunner.base.own_folder import cache_base, own_folder

FOLDER = Path(__file__).with_name("c")
_OPTIONS = (
    "-std=gnu11",
    "-O2",
    "-Wall",
    "-Wextra",
    "-Wno-unused-parameter",
    "-Wno-unused-function",
    "-shared",
    "-fPIC",
)
_BEHIND = ("-ldl", "-lpthread")


def bench_library() -> Path:
    """The library that the bench loads: clock, nodes and bus."""
    return _built("virtual_bus", FOLDER.glob("virtual_bus.c"))


def preload_library() -> Path:
    """The library that is preloaded into a firmware."""
    return _built("preload", FOLDER.glob("preload_*.c"))


def _built(name: str, sources: Iterable[Path]) -> Path:
    """The shared object of some sources, compiled if it is not there yet.

    Raises:
        UsageError: no C compiler, or it refuses the source.
        FolderError: no folder of our own to keep it in.
    """
    digest = hashlib.sha256(" ".join(_OPTIONS).encode())
    for source in sorted(FOLDER.glob("*.[ch]")):
        digest.update(source.name.encode() + source.read_bytes())
    library = own_folder(cache_base() / "virtual") / f"{name}-{digest.hexdigest()[:16]}.so"
    if not library.is_file():
        _compile(sorted(sources), library)
    return library


def _compile(sources: list[Path], library: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise UsageError("--virtual", "there is no C compiler", remedy="install gcc: virtual time is compiled once")
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        fresh = Path(folder) / library.name
        line = [compiler, *_OPTIONS, "-o", str(fresh), *map(str, sources), *_BEHIND]
        done = subprocess.run(line, capture_output=True, text=True)
        if done.returncode:
            words = " ".join(done.stderr.split())[:300]
            raise UsageError("--virtual", f"{compiler} refuses {library.name}: {words}", remedy="install a newer gcc")
        fresh.replace(library)  # whole or not at all: several runs may start at once
