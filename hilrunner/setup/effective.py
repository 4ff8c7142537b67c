"""The profile as a run used it: the options of the command line in it, every default written out, as JSON.

The log keeps the text a person wrote as well, but that text is never edited: what a replay reads is this structure, written from the
checked profile and read back by the same checks.
"""

from collections.abc import Mapping

import msgspec

from hilrunner.base.errors import ProfileError
from hilrunner.setup.profile import Profile, convert_profile, parse_profile

PROFILE_ATTACHMENT = "profile.toml"  # the text as it was written
EFFECTIVE_ATTACHMENT = "profile.effective.json"


def effective_json(profile: Profile) -> bytes:
    """The profile with every key, for people and for `read_effective`."""
    return msgspec.json.format(msgspec.json.encode(profile), indent=2) + b"\n"


def read_effective(data: bytes, place: str) -> Profile:
    """The inverse of `effective_json`, checked like any profile; ProfileError."""
    try:
        raw = msgspec.json.decode(data, type=dict)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ProfileError(place, f"is damaged: {error}") from error
    return convert_profile(raw, place)


def profile_of_log(attachments: Mapping[str, bytes], place: str) -> Profile | None:
    """The profile a log was recorded with, None where it holds none; ProfileError where this version refuses it.

    Logs of versions before this structure hold the text alone.
    """
    if EFFECTIVE_ATTACHMENT in attachments:
        return read_effective(attachments[EFFECTIVE_ATTACHMENT], f"{place}: {EFFECTIVE_ATTACHMENT}")
    if PROFILE_ATTACHMENT in attachments:
        text = attachments[PROFILE_ATTACHMENT].decode("utf-8", "replace")
        return parse_profile(text, f"{place}: {PROFILE_ATTACHMENT}")
    return None
