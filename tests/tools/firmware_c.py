"""The C of firmware_iface, compiled with warnings as errors and the undefined-behaviour sanitizer, callable from Python.

Undefined behaviour (overflow, bad shift, misaligned or out-of-range access) ends the test process with a message.
"""

import hashlib
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import cffi

from hilrunner.base.own_folder import cache_base, own_folder

FOLDER = Path(__file__).resolve().parents[2] / "firmware_iface" / "c"
SOURCES = ("e2e_p02.c", "actuator_messages.c", "wave.c", "motion_controller.c")
HEADERS = ("e2e_p02.h", "actuator_messages.h", "wave.h", "motion_controller.h")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
SANITIZER = ("-fsanitize=undefined", "-fno-sanitize-recover=all")


def declarations() -> str:
    """The headers as cffi reads them: preprocessed, system headers left out."""
    text = "\n".join(
        line for name in HEADERS for line in (FOLDER / name).read_text().splitlines() if not line.startswith("#include")
    )
    done = subprocess.run(["cc", "-E", "-P", "-"], input=text, capture_output=True, text=True, check=True)
    return done.stdout


@cache
def load():
    """(ffi, lib) of the core, built once a source state."""
    digest = hashlib.sha256()
    for name in (*SOURCES, *HEADERS):
        digest.update((FOLDER / name).read_bytes())
    folder = own_folder(cache_base() / f"firmware-c-{digest.hexdigest()[:16]}")
    library = folder / "libactuator.so"
    if not library.exists():
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".so", delete=False) as fresh:
            target = Path(fresh.name)
        sources = [str(FOLDER / name) for name in SOURCES]
        subprocess.run(
            ["cc", "-O1", "-g", *STRICT, *SANITIZER, "-shared", "-fPIC", "-o", str(target), *sources, "-lm"], check=True
        )
        target.rename(library)
    ffi = cffi.FFI()
    ffi.cdef(declarations())
    return ffi, ffi.dlopen(str(library))
