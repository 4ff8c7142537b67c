"""Can a program be followed in virtual time? Read from its file, before it is started.

The preloaded object stands in for calls of the C library. A program that has none of its own (linked statically) or that makes its system
calls itself (Go) would meet the real clock and the real bus unseen: it is refused. ELF: Tool Interface Standard, version 1.2.
"""

import os
import shutil
import stat
import struct
from pathlib import Path

from hilrunner.base.errors import UsageError

_MAGIC = b"\x7fELF"
_INTERPRETER = 3  # PT_INTERP: the program asks for a dynamic loader
_GO_MARK = b"\xff Go buildinf:"
_GO_LOOK_BYTES = 64 << 20
_SCRIPTS_MAX = 4


def find_program(word: str) -> Path:
    """The file that a command names, on the path or directly.

    Raises:
        UsageError: there is none, or it cannot be executed.
    """
    found = shutil.which(word)
    if found is None:
        problem = "cannot be executed" if os.path.exists(word) else "no such program"
        raise UsageError(f"firmware {word!r}", problem, remedy="name a program after --, as in: -- ./firmware -i vcan0")
    return Path(found)


def check_program(word: str) -> None:
    """Refuse what cannot be followed.

    Raises:
        UsageError: not found, linked statically, Go, another architecture, or with rights of its own (setuid).
    """
    path = find_program(word)
    for _ in range(_SCRIPTS_MAX):
        with open(path, "rb") as file:
            head = file.read(4096)
        if head[:2] != b"#!":
            _check_elf(word, path, head)
            return
        words = head[2:].split(b"\n", 1)[0].split()
        if not words:
            return
        path = find_program(os.fsdecode(words[1] if words[0].endswith(b"/env") and len(words) > 1 else words[0]))


def _refuse(word: str, problem: str, remedy: str) -> None:
    raise UsageError(f"firmware {word!r}", f"virtual time cannot follow it: {problem}", remedy=remedy)


def _check_elf(word: str, path: Path, head: bytes) -> None:
    if head[:4] != _MAGIC:
        _refuse(word, "it is neither a program of Linux nor a script", "name the program itself")
    if head[4] != 2 or head[5] != 1:
        _refuse(word, "it is not a 64-bit little-endian program", "compile it for this machine")
    with open("/proc/self/exe", "rb") as file:
        ours = file.read(20)
    if head[18:20] != ours[18:20]:
        _refuse(word, "it is compiled for another processor", "compile it for this machine")
    if path.stat().st_mode & (stat.S_ISUID | stat.S_ISGID):
        _refuse(
            word, "it takes other rights when it starts (setuid), so nothing is preloaded", "run a plain copy of it"
        )
    if not _has_interpreter(path, head):
        _refuse(word, "it is linked statically and brings its own system calls", "link it with the shared C library")
    if _is_go(path):
        _refuse(word, "it is written in Go, which makes its system calls itself", "use a real or virtual CAN interface")


def _has_interpreter(path: Path, head: bytes) -> bool:
    offset, size, count = struct.unpack_from("<Q", head, 32)[0], *struct.unpack_from("<HH", head, 54)
    with open(path, "rb") as file:
        file.seek(offset)
        table = file.read(size * count)
    kinds = [struct.unpack_from("<I", table, k * size)[0] for k in range(len(table) // size if size else 0)]
    return _INTERPRETER in kinds


def _is_go(path: Path) -> bool:
    with open(path, "rb") as file:
        return _GO_MARK in file.read(_GO_LOOK_BYTES)
