"""What it means that a log does not match its own checksums or hashes, as an error and as comparisons of hashes."""

import hashlib

from hilrunner.base import exit_codes
from hilrunner.base.errors import LogError

_HASH_PREFIX = "sha256:"  # of an attachment, in the metadata table `run`: sha256:<name> -> hexadecimal digest


class DamagedLogError(LogError):
    """A log so damaged that there is nothing to report of."""

    exit_code = exit_codes.DAMAGED

    def __init__(self, place: str, problem: str) -> None:
        super().__init__(
            place,
            problem,
            "a log that matches its own checksums",
            "take another copy of the log, from where it was written",
        )


def hash_mismatches(metadata: dict[str, dict[str, str]], attachments: dict[str, bytes]) -> list[str]:
    """Attachments that are not those whose SHA-256 the log's metadata names, in words.

    Args:
        metadata: tables of the log. attachments: name -> data.
    """
    told = []
    table = metadata.get("run", {})
    named = {key.removeprefix(_HASH_PREFIX): text for key, text in table.items() if key.startswith(_HASH_PREFIX)}
    if "profile_sha256" in table:
        named.setdefault("profile.toml", table["profile_sha256"])
    for name, digest in named.items():
        data = attachments.get(name)
        if data is not None and hashlib.sha256(data).hexdigest() != digest:
            told.append(f"the attachment {name} is not the one whose SHA-256 the log names ({digest[:16]}…)")
    return told
