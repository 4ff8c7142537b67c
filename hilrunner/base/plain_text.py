"""Text from files, made harmless where it is shown: a name in a log must not move the cursor or write a line of its own.

Control characters (a terminal obeys them), characters that turn the direction of a line or cannot be seen (they make one
word look like another), and halves of surrogate pairs (no encoding takes them) are shown as Python would write them: `\\x1b`.
"""

import re

_INNER = "\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff\ufff9-\ufffb\ufffe\uffff\U000e0000-\U000e007f"
_HARMFUL = re.compile(f"[{_INNER}]")  # in a text of several lines
_HARMFUL_IN_LINE = re.compile(f"[\t\n{_INNER}]")
CHARACTERS_MAX = 2000  # of one value: more is no name and no sentence


def plain_line(text: object, characters_max: int = CHARACTERS_MAX) -> str:
    """A value as part of one line: no line break, nothing a terminal obeys, not longer than a person reads."""
    return _HARMFUL_IN_LINE.sub(_escaped, shortened(str(text), characters_max))


def plain_text(text: str) -> str:
    """A text of several lines: line breaks and tabs stay."""
    return _HARMFUL.sub(_escaped, text)


def plain_keys(table: dict) -> dict:
    """The same values under names that are each part of one line."""
    return {plain_line(key): value for key, value in table.items()}


def plain_table(table: dict) -> dict[str, str]:
    """Names and values, each as part of one line."""
    return {plain_line(key): plain_line(value) for key, value in table.items()}


def shortened(text: str, characters_max: int = CHARACTERS_MAX) -> str:
    """The beginning of a text that is too long, and how much was left out."""
    if len(text) <= characters_max:
        return text
    return f"{text[:characters_max]}… ({len(text) - characters_max} characters more)"


def _escaped(match: re.Match) -> str:
    return match[0].encode("unicode_escape", "surrogatepass").decode("ascii")
