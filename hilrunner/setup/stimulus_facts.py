"""How a stimulus was understood, for people in one line and for scripts as a dictionary."""

import math
from dataclasses import dataclass, field

from hilrunner.base.plain_text import plain_line


@dataclass(frozen=True)
class StimulusFacts:
    """What was read of a schedule or a CAN log; the fields of frames stay empty for a schedule."""

    name: str
    form: str  # "schedule", "schedule file", or the format of the log
    span_s: float  # from the first to the last frame or row
    tick_count: int  # periods it was made into
    frame_count: int = 0
    valid_count: dict[str, int] = field(default_factory=dict)  # axis -> valid commands
    refused: dict[str, int] = field(
        default_factory=dict
    )  # why a frame with a command's identifier was no command -> how many
    channels: tuple[str, ...] = ()  # all of the log
    used_channels: tuple[str, ...] = ()  # those with valid commands
    stamps: str = "absolute"
    other_lines: int = 0  # lines or objects of a log that are no frames
    longest_gap_s: float = math.nan  # between two valid commands of one axis, or two rows of a table
    warnings: tuple[str, ...] = ()

    def text(self) -> str:
        """One line: name, form, span, frames, valid commands, channels, longest gap; names in it harmless, also in a log."""
        parts = [f"{self.span_s:.3f} s"]
        if self.frame_count:
            parts.append(f"{self.frame_count} frames")
            parts.append(self._valid_text())
            parts += [f"refused: {count} {reason}" for reason, count in self.refused.items()]
        if self.other_lines:
            parts.append(f"{self.other_lines} other entries")
        if math.isfinite(self.longest_gap_s) and self.longest_gap_s > 0.0:
            parts.append(f"longest gap {self.longest_gap_s:.3f} s")
        form = self.form if self.stamps == "absolute" else f"{self.form} with stamps {self.stamps}"
        return plain_line(f"stimulus {self.name}: {form}, {', '.join(parts)}; {self.tick_count} periods")

    def as_dict(self) -> dict:
        """The same for JSON; what does not apply is null."""
        gap_s = self.longest_gap_s if math.isfinite(self.longest_gap_s) else None
        return {
            "name": self.name,
            "form": self.form,
            "span_s": self.span_s,
            "tick_count": self.tick_count,
            "frame_count": self.frame_count,
            "valid_count": self.valid_count,
            "refused": self.refused,
            "channels": list(self.channels),
            "used_channels": list(self.used_channels),
            "stamps": self.stamps,
            "other_lines": self.other_lines,
            "longest_gap_s": gap_s,
            "warnings": list(self.warnings),
        }

    def _valid_text(self) -> str:
        counts = ", ".join(f"{axis} {count}" for axis, count in self.valid_count.items())
        text = f"{sum(self.valid_count.values())} valid commands" + (
            f" ({counts})" if len(self.valid_count) > 1 else ""
        )
        used = ", ".join(one for one in self.used_channels if one)
        if not used:
            return text
        return f"{text} on channel {used}" + (
            f" (of {', '.join(self.channels)})" if len(self.channels) > len(self.used_channels) else ""
        )
