"""What a log says about its own run: profile, period, host, mode, versions, how it ended."""

import json
import tomllib
from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.errors import ProfileError
from hilrunner.base.plain_text import plain_keys, plain_line, plain_table
from hilrunner.base.units import NS_PER_US
from hilrunner.evidence.reader import Run
from hilrunner.setup import host
from hilrunner.setup.effective import PROFILE_ATTACHMENT, profile_of_log
from hilrunner.setup.host_words import Finding
from hilrunner.setup.profile import Profile

_NS_PER_MS = 1_000_000
DEFAULT_PERIOD_NS = _NS_PER_MS
# what a run can have, as setup.profile bounds it; a period of a later version may be shorter
_PERIOD_NS = (NS_PER_US, 1_000_000 * NS_PER_US)
_WARM_UP_TICKS = (0, 1_000_000)
_BITRATE = (0, 100_000_000)
_COUNT = (0, 1 << 63)
_ROWS_MAX = 1000


@dataclass(frozen=True)
class RunFacts:
    """Facts beside the measurements; `notes` says in words what is missing or doubtful."""

    profile: Profile | None
    profile_name: str
    profile_problem: str  # why there is no profile to judge by; empty: there is one
    limits: dict[str, float]  # [limits] of the profile, also of one this version cannot read otherwise
    period_ns: int
    warm_up_ticks: int
    bitrate: int  # 0: not known
    exit_reason: str
    mode_label: str  # judged again with the misses of the run
    mode_reasons: tuple[str, ...]
    findings: tuple[Finding, ...]
    grants: tuple[dict, ...]
    host: dict[str, str]  # facts of the host
    provenance: dict[str, str]  # versions, revision, hashes, seeds
    notes: tuple[str, ...]
    clamped: dict[str, int] = field(default_factory=dict)  # MESSAGE.signal -> values outside its range; sent as its end

    def __post_init__(self) -> None:
        """All of it is shown to people, and a log comes from anywhere."""
        shown = {name: plain_line(getattr(self, name)) for name in ("profile_name", "exit_reason", "mode_label")}
        shown |= {name: tuple(map(plain_line, getattr(self, name))) for name in ("mode_reasons", "notes")}
        shown |= {name: plain_table(getattr(self, name)) for name in ("host", "provenance")}
        shown |= {name: plain_keys(getattr(self, name)) for name in ("limits", "clamped")}
        for name, value in shown.items():
            object.__setattr__(self, name, value)


def read_facts(run: Run, miss_count: int = 0) -> RunFacts:
    """Facts of a run; nothing is taken for granted, so a log of any age or state gives some.

    Args:
        miss_count: late ticks of the run, known once they are counted; a run with late ticks is not real-time verified.
    """
    notes: list[str] = []
    table = run.metadata.get("run", {})
    profile, problem = _profile(run, notes)
    period_ns = _period_ns(run, table, profile, notes)
    warm_up = profile.bench.warm_up_ticks if profile else 0
    warm_up = _number(table.get("warm_up_ticks"), warm_up, _WARM_UP_TICKS, "warm_up_ticks", notes)
    label, reasons, findings, grants = _mode(run.metadata.get("host", {}), miss_count, notes)
    exit_reason = table.get("exit_reason", "")
    if not exit_reason:
        notes.append("how the run ended is not in the log: it was not finished")
    left_out = {"findings", "grants", "mode_label", "mode_reasons"}
    return RunFacts(
        profile=profile,
        profile_problem=problem,
        limits=_limits(run, profile),
        profile_name=table.get("profile_name") or table.get("profile") or (profile.name if profile else "unknown"),
        period_ns=period_ns,
        warm_up_ticks=warm_up,
        bitrate=_number(
            table.get("can_bitrate") or table.get("bitrate"),
            profile.can.bitrate if profile else 0,
            _BITRATE,
            "bitrate",
            notes,
        ),
        exit_reason=exit_reason or "unknown",
        mode_label=label,
        mode_reasons=tuple(reasons),
        findings=tuple(findings),
        grants=tuple(grants),
        host={key: value for key, value in run.metadata.get("host", {}).items() if key not in left_out},
        provenance={key: value for key, value in table.items() if key != "exit_reason"},
        notes=tuple(notes),
        clamped={
            name: _number(count, 0, _COUNT, f"clamped {name}", notes)
            for name, count in run.metadata.get("clamped", {}).items()
        },
    )


def _profile(run: Run, notes: list[str]) -> tuple[Profile | None, str]:
    """The profile as the run used it (the structure the log holds, or of an older log the text), or why there is none to judge by."""
    try:
        profile = profile_of_log({name: one.data for name, one in run.attachments.items()}, str(run.path))
    except ProfileError as error:
        notes.append(f"the profile in the log is not one of this version: {error}")
        return None, f"the profile in the log is not one of this version: {error}"
    if profile is None:
        notes.append("the log carries no profile: no limits to judge by, period taken from the ticks")
        return None, "the log carries no profile"
    return profile, ""


def _limits(run: Run, profile: Profile | None) -> dict[str, float]:
    if profile is not None:
        return dict(profile.limits)
    try:
        table = tomllib.loads(run.attachments[PROFILE_ATTACHMENT].text).get("limits", {})
        return {key: float(value) for key, value in table.items()}
    except (KeyError, tomllib.TOMLDecodeError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        return {}


def _period_ns(run: Run, table: dict[str, str], profile: Profile | None, notes: list[str]) -> int:
    of_profile = profile.bench.period_us * NS_PER_US if profile else 0
    told = _number(table.get("period_ns"), of_profile, _PERIOD_NS, "period_ns", notes)
    ticks = run.tick
    if told or len(ticks) < 2:
        return told or DEFAULT_PERIOD_NS
    steps = np.diff(ticks["tick"].astype(np.int64)[:1000])
    spans = np.diff(ticks["deadline_mono_ns"][:1000])
    measured = spans[steps > 0] / steps[steps > 0]
    notes.append("the period is measured from the ticks")
    period_ns = int(round(float(np.median(measured)))) if len(measured) else DEFAULT_PERIOD_NS
    if not _PERIOD_NS[0] <= period_ns <= _PERIOD_NS[1]:
        notes.append(
            f"the deadlines of the ticks are {period_ns} ns apart, which is no period: times are not to be trusted"
        )
        return DEFAULT_PERIOD_NS
    return period_ns


def _mode(table: dict[str, str], miss_count: int, notes: list[str]) -> tuple[str, list[str], list, list]:
    told = table.get("mode_label", "")
    if not told:
        notes.append("the log does not say what its host granted")
        return "unknown", [], [], []
    findings = [Finding(**row) for row in _rows(table.get("findings"), ("name", "value", "verdict", "remedy"), notes)]
    grants = _rows(table.get("grants"), ("name", "asked", "got", "granted", "reason", "remedy"), notes)
    if told == host.LABEL_SIMULATED:
        return told, [], findings, grants
    reasons = [reason for reason in table.get("mode_reasons", "").split("; ") if reason]
    if miss_count:
        reasons.append(f"{miss_count} ticks were late")
    return (told if not reasons else host.LABEL_BEST_EFFORT), reasons, findings, grants


def _rows(text: str | None, keys: tuple[str, ...], notes: list[str]) -> list[dict]:
    if not text:
        return []
    try:
        rows = json.loads(text)[:_ROWS_MAX]
        return [{key: _plain(row[key]) for key in keys} for row in rows]
    except (ValueError, KeyError, TypeError, RecursionError):
        notes.append("a table of host findings in the log cannot be read")
        return []


def _plain(value) -> str | bool:
    return value if isinstance(value, bool) else plain_line(value)


def _number(text, default: int, allowed: tuple[int, int], key: str, notes: list[str]) -> int:
    """A whole number of the table `run`; one that no run can have is told and not used."""
    try:
        number = int(text)
    except (TypeError, ValueError):
        return default
    if not allowed[0] <= number <= allowed[1]:
        notes.append(f"{key} {number} in the log is not one of a run ({allowed[0]} to {allowed[1]}): {default} is used")
        return default
    return number
