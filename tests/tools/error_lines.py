"""What a command said on standard error beside telling that it compiles: a cold cache on the way is no second error."""

from hilrunner.commands.compile_progress import PREFIX


def error_lines(told: str) -> list[str]:
    """Its lines without those of `compile_progress`, which come or not as the cache is cold or warm."""
    return [line for line in told.strip().splitlines() if not line.startswith(PREFIX)]
