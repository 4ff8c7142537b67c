"""The campaigns of `make test-long`: one row each. A new campaign is a row here, or a test file in tests/long.

A row is a name and the words of a command that exits with 0 only if everything it tried held. `{seed}` in a word becomes the seed,
`{python}` the interpreter of .venv; a word that begins with `tools/` or `tests/` is a path inside the project.
"""

CAMPAIGNS: dict[str, tuple[str, ...]] = {}
