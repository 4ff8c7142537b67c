"""The campaigns of `make test-long`: one row each. A new campaign is a row here, or a test file in tests/long.

A row is a name and the words of a command that exits with 0 only if everything it tried held. `{seed}` in a word becomes the seed,
`{python}` the interpreter of .venv; a word that begins with `tools/` or `tests/` is a path inside the project.
"""

_ATTACKS = (
    "cut", "flip", "logs", "databases", "profiles", "networks", "kill", "signal", "stall", "disk", "syscall",
)  # fmt: skip

CAMPAIGNS: dict[str, tuple[str, ...]] = {
    f"attack-{name}": ("{python}", "tools/attack", name, "--seed", "{seed}") for name in _ATTACKS
}
