"""What is to be run in a lab, and how: the command with its limits, the same for every lab."""

import os
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Job:
    """One command that is to see a CAN bus."""

    command: list[str]
    limit_s: float | None = None  # None: until it ends
    memory: str = "3G"  # of a guest, taken as it is used
    bit_rate_bps: int = 1_000_000  # of emulated controllers
    quiet: bool = False
    console_path: Path | None = None  # where a guest's kernel messages are kept
    namespace: bool = False  # this process is in a network namespace made for the command
    environment: dict[str, str] = field(default_factory=lambda: dict(os.environ))

    def environment_in(self, lab: str) -> dict[str, str]:
        """The command's environment, which names the lab."""
        return self.environment | {"HILRUNNER_CAN_LAB": lab}
