"""Runs of the demo's emulated robot, made again where a busy computer spoils them."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from typing import Final

from deal_hw.control.process.channel import Outcome
from deal_hw.data.checks.suite import check as check_recording
from deal_hw.data.recording.reader import read_episode
from deal_hw.errors import SafetyError, TransportError
from deal_hw.findings import Severity
from deal_hw.load import Load
from deal_hw.workflows.causes import LATE, late_advice
from deal_hw.workflows.running.report import EpisodeReport, RunReport

ATTEMPTS: Final = 5
"""Most recordings until one can be used, and most deployments until one is not late. A robot that is emulated
may be armed again without a look at it."""


def recorded(record: Callable[[int], RunReport], what: str, count: int = 1) -> RunReport:
    """Record, and record again if the recording ended early or cannot be used for calibration.

    Args:
        record: Records; called with the number of recordings before that the motion itself ended.
        what: A recording, in messages.
        count: Episodes of a recording. One that hardly moved does not count: a stronger one follows it.

    Returns:
        The run with the episodes that can be used, all of one call.

    Raises:
        SafetyError: None could be used.
    """
    reason, late, gentler = "", False, 0
    for before in range(ATTEMPTS):
        try:
            report = record(gentler)
        except (SafetyError, TransportError) as error:
            reason, late = str(error), True
        else:
            episodes = report.episodes[-count:]
            spoilt = next(((one, why) for one in episodes if (why := _unusable(one))), None)
            if spoilt is None:
                return dataclasses.replace(report, episodes=episodes)
            reason, late = spoilt[1], spoilt[0].outcome is Outcome.FINISHED or _late(spoilt[0])
            gentler += not late
        again = f"; it is made again, {before + 2} of {ATTEMPTS}" if before + 1 < ATTEMPTS else ""
        _warn(f"the {what} cannot be used for calibration ({reason}); {Load.now()}{again}")
    remedy = "this robot does not bear the motion; try another --seed"
    advice = late_advice(True, Load.now()) if late else remedy
    raise SafetyError(
        f"no {what} of {ATTEMPTS} can be used for calibration; the last one: {reason}. {advice}"
    )


def deployed(deploy: Callable[[int], RunReport], count: int, what: str) -> RunReport:
    """Deploy a policy, and again instead of a deployment that only came late.

    A deployment that trips for another reason is a result, and the last one, as in `deal-hw deploy`.

    Args:
        deploy: Deploys as often as requested.
        count: Deployments.
        what: A deployment, in messages.

    Raises:
        SafetyError: Each attempt failed.
        TransportError: Each attempt failed.
    """
    episodes: list[EpisodeReport] = []
    spare = ATTEMPTS - 1
    while True:
        try:
            report = deploy(count - len(episodes))
            episodes += report.episodes
        except (SafetyError, TransportError) as error:
            if not spare:
                raise
            reason = str(error)
        else:
            last = episodes[-1]
            if last.outcome is Outcome.FINISHED or not _late(last) or not spare:
                return dataclasses.replace(report, episodes=tuple(episodes))
            reason = episodes.pop().reason
        spare -= 1
        _warn(f"the {what} ended early ({reason}); {Load.now()}; it is made again")


def numbers(run: RunReport) -> tuple[int, ...]:
    """Return the numbers of a run's recordings in their dataset."""
    return tuple(int(path.stem) for path in run.paths)


def _unusable(episode: EpisodeReport) -> str:
    """Return why a recording cannot be used for calibration; "" if it can."""
    if episode.outcome is not Outcome.FINISHED or episode.path is None:
        return episode.reason
    verdicts = check_recording(read_episode(episode.path).trajectory)
    return "; ".join(v.message for v in verdicts if v.severity is Severity.FAIL)


def _late(episode: EpisodeReport) -> bool:
    return bool(LATE.intersection(episode.flags))


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr, flush=True)
