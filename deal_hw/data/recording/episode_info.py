"""The entry of a dataset's index for one episode, and whether the episode is used."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from deal_hw.data.checks.clock_sync import synchronize
from deal_hw.data.checks.suite import check
from deal_hw.data.recording.excitation import excitation
from deal_hw.data.recording.reader import Episode, read_episode
from deal_hw.errors import ConfigurationError, EmptyRecordingError, InsufficientDataError, short, shown
from deal_hw.findings import Finding, Severity
from deal_hw.schema import STRICT

KEPT = "kept"
"""Fact of an episode that the user wants to use although its run failed."""
_FAILED = {"tripped": "the safety module ended it", "failed": "its run failed"}
"""Outcomes of runs whose recordings are left out, in words."""
EXAMPLE = "episodes/000007.mcap"
"""A name of an episode's file in its dataset, for messages."""
_FILE = re.compile(r"episodes/(\d{6,9})\.mcap", re.ASCII)
_MOST_JUMPS = 20
"""Largest number of clock jumps in an entry; a recording with very many must not fill the index."""
_VERDICT = {"name", "severity", "message"}
_CLOCK = {"offset_s", "drift_ppm", "offset_uncertainty_s", "drift_uncertainty_ppm"}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeInfo:
    """The entry of ``dataset.json`` for one episode.

    Attributes:
        file: Path inside the dataset, such as "episodes/000000.mcap".
        purpose: Why it was recorded, such as "collect" or "deploy".
        policy_digest: Digest of the policy that commanded; "" for none.
        wall_utc: Wall-clock time at its start, ISO 8601.
        duration_s: Device time from the first to the last sample [s].
        states: State samples.
        commands: Commands sent.
        cycles: Control cycles.
        verdicts: The findings of the checks: ``name``, ``severity`` and ``message`` of each.
        excitation: Movement, as ``excitation.Excitation.to_json`` writes it.
        clock: Relation of the clocks, as ``clock_sync.ClockSync.to_json`` writes it, with 20 jumps at most;
            None if unknown.
        note: A note for the operator, such as on a repair.
        facts: Values that the collector adds: outcome, loop_timing, task, ...; and :data:`KEPT`.

    Raises:
        ConfigurationError: The file is outside the dataset, a verdict is invalid, or the clock's numbers are
            missing.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    file: str
    purpose: str
    policy_digest: str
    wall_utc: str
    duration_s: float
    states: int
    commands: int
    cycles: int
    verdicts: tuple[Mapping[str, str], ...]
    excitation: Mapping[str, Any] | None
    clock: Mapping[str, Any] | None
    note: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # The file field decides which file is read, and dataset.json may come from elsewhere.
        parts = Path(self.file).parts
        if len(parts) != 2 or parts[0] != "episodes" or ".." in parts or "\0" in self.file:
            raise ConfigurationError(
                f"episode file {shown(self.file)} is not inside the dataset's episodes/ folder"
            )
        for verdict in self.verdicts:
            if _VERDICT - verdict.keys() or verdict["severity"] not in tuple(Severity):
                raise ConfigurationError(f"field verdicts holds {shown(dict(verdict))}, which is no verdict")
        clock, excitation = self.clock or {}, self.excitation or {}
        if self.clock is not None and not all(name in clock and _is_number(clock[name]) for name in _CLOCK):
            raise ConfigurationError(f"field clock is {shown(dict(clock))}; wanted: numbers or null")
        for value in excitation.values():
            if not all(_is_number(part) for part in (value if isinstance(value, list | tuple) else [value])):
                raise ConfigurationError(f"field excitation holds {shown(value)}; wanted: numbers")

    @property
    def number(self) -> int:
        """The episode's number, that of its file; it stays when other episodes are removed. -1: none."""
        return number_in(self.file)

    @property
    def failure(self) -> str:
        """Why its run failed, as text; "" if it did not."""
        how = _FAILED.get(str(self.facts.get("outcome")), "")
        return how and f"{how} ({short(self.facts.get('reason') or 'for an unknown reason')})"

    @property
    def left_out(self) -> str:
        """Why nothing uses it unless it is named; "" if it is used.

        This is the mark of an episode. Nothing else decides it, so that datasets of any age behave alike.
        """
        if not self.states:
            return "it holds no state sample"
        return "" if self.facts.get(KEPT) is True else self.failure

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """The messages of its failed checks: it cannot be calibrated, even if it is named."""
        return tuple(verdict["message"] for verdict in self.verdicts if verdict["severity"] == Severity.FAIL)


def number_in(file: str) -> int:
    """Return the number of an episode from its file in the dataset; -1 if that has no such name."""
    found = _FILE.fullmatch(file)
    # One number has one name: 000001, not 0000001.
    return int(found[1]) if found and found[1] == f"{int(found[1]):06d}" else -1


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def summarize(
    path: Path, file: str, note: str = "", facts: Mapping[str, Any] | None = None
) -> tuple[EpisodeInfo, Episode | None]:
    """Read an episode; return its entry for the index, and the episode.

    Without samples the entry has zeros and a note, and the episode is None.

    Args:
        path: The file.
        file: The same, inside the dataset.
        note: For the operator.
        facts: Plain JSON values that the collector adds.
    """
    try:
        episode = read_episode(path)
    except EmptyRecordingError as error:
        nothing = EpisodeInfo(
            file=file,
            purpose="",
            policy_digest="",
            wall_utc="",
            duration_s=0.0,
            states=0,
            commands=0,
            cycles=0,
            verdicts=(verdict_json(Finding("length", Severity.FAIL, str(error))),),
            excitation=None,
            clock=None,
            note=note or "empty",
            facts=facts or {},
        )
        return nothing, None
    trajectory = episode.trajectory
    info = EpisodeInfo(
        file=file,
        purpose=str(episode.metadata.get("purpose", "")),
        policy_digest=str(episode.metadata.get("policy_digest", "")),
        wall_utc=episode.wall_utc,
        duration_s=trajectory.duration_s,
        states=trajectory.device_s.size,
        commands=trajectory.sent_s.size,
        cycles=episode.cycles.cycle.size,
        verdicts=tuple(map(verdict_json, check(trajectory))),
        excitation=excitation(trajectory).to_json(),
        clock=_clock(episode),
        note=note,
        facts=facts or {},
    )
    return info, episode


def verdict_json(finding: Finding) -> Mapping[str, str]:
    """Return a finding as the index has it."""
    return {"name": finding.code, "severity": str(finding.severity), "message": finding.message}


def _clock(episode: Episode) -> Mapping[str, Any] | None:
    try:
        found = synchronize(episode.trajectory).to_json()
    except InsufficientDataError:
        return None
    return {**found, "jumps": found["jumps"][:_MOST_JUMPS]}


def motion_of(metadata: Mapping[str, Any]) -> str:
    """Return the motion of a recording, from its metadata or its facts; "" if unknown."""
    # Until November 2026 it was called a profile.
    return str(metadata.get("motion") or metadata.get("profile") or "")
