"""Starts the two processes of an episode, recorder and control, and waits for their ends."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw.clock import MonotonicClock
from deal_hw.control.loop.after_death import passive_after
from deal_hw.control.loop.timing import LoopTimingReport
from deal_hw.control.process.channel import MAKING_PASSIVE, Beat, Outcome
from deal_hw.control.process.run_note import RunNote
from deal_hw.control.process.supervisor import ChildEnd, Supervisor
from deal_hw.control.safety.passive import PassiveConfig
from deal_hw.data.checks.following import followed_part
from deal_hw.data.recording.excitation import Excitation
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.recorder_launch import start_recorder
from deal_hw.errors import DealHwError
from deal_hw.load import Load
from deal_hw.robot import Robot
from deal_hw.robots import balanced, robot_entry, walked
from deal_hw.robots.connect import on_this_computer, spoilt_on_purpose
from deal_hw.signals import OPERATOR, name
from deal_hw.version import __version__
from deal_hw.workflows.causes import LATE, corrupt_advice, late_advice
from deal_hw.workflows.running.commander import OTHERS_S
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.report import EpisodeReport
from deal_hw.workflows.running.sleep_lock import ASLEEP
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.motions.scores.balance import BalanceResult
    from deal_hw.motions.scores.replay_error import ReplayError
    from deal_hw.motions.scores.velocity_error import VelocityError
    from deal_hw.types import Trajectory


_CHECKING = "checking the recording"
_TRIED_AGAIN = PassiveConfig(timeout_s=1.0)
"""Time of the supervisor's own passive route after the control process failed for its whole time [s]."""


class EpisodeRun:
    """One episode: a recorder, a control process, and the report on both."""

    def __init__(
        self,
        plan: RunPlan,
        robot: Robot,
        port: str,
        store: Dataset | None,
        purpose: str,
        task: str,
        attempt: int = 0,
        keep_fds: tuple[int, ...] = (),
        say: Say = silent,
        note: RunNote | None = None,
    ) -> None:
        self._note, self._say, self._keep_fds = note, say, keep_fds
        self.signal = ""
        """Name of the signal by which the operator ended it, or ""."""
        self._supervisor: Supervisor | None = None
        self._stop_cause = ""
        self._plan, self._robot, self._port, self._store = plan, robot, port, store
        self._path = store.next_episode_path() if store is not None else None
        self._metadata = {
            "robot": robot.description.name,
            "description_digest": robot.description.digest(),
            "purpose": purpose,
            "task": task,
            "motion": plan.motion,
            "policy": plan.policy,
            "policy_digest": plan.policy_digest[:16],
            "recording": plan.recording,
            "excite": plan.excite,
            "seed": plan.seed,
            "seconds": plan.seconds,
            "excitation_level": plan.excitation_level,
            "attempt": attempt,
            "dry_run": plan.dry_run,
            "velocity": plan.velocity,
            "stand": plan.stand,
            "deal_hw": __version__,
        }

    def run(self, on_beat: Callable[[Beat], None]) -> EpisodeReport:
        """Run it and return the report."""
        recorder = None
        if self._path is not None:
            recorder = start_recorder(self._path, self._robot.description.to_json(), self._metadata)
            try:
                recorder.wait_ready()
            except BaseException:
                recorder.finish()
                raise
        port_fd = self._robot.fileno()
        self._supervisor = supervisor = Supervisor(
            module="deal_hw.workflows.running.control_process",
            plan=self._plan.to_json(),
            port_fd=port_fd if port_fd >= 0 else None,
            passive=lambda phase, tried: self._make_passive(supervisor, phase, tried, on_beat),
            recorder=recorder,
            on_beat=on_beat,
            keep_fds=self._keep_fds,
            note=self._note,
        )
        if self._stop_cause:
            supervisor.stop(self._stop_cause)
        with contextlib.ExitStack() as listening:
            if self._plan.velocity == "keyboard":
                from deal_hw.workflows.running.keyboard import keys

                listening.enter_context(keys(supervisor.tell, lambda: supervisor.stop(OPERATOR), self._say))
            end = supervisor.run()
        self.signal = end.signal
        report = dataclasses.replace(
            account(
                end,
                self._path,
                self._robot.if_cut,
                on_this_computer(self._plan.transport, self._plan.port),
                spoilt_on_purpose(self._plan.transport, self._plan.port, self._plan.wire).held,
            ),
            planned_s=self._plan.total_s,
        )
        report = dataclasses.replace(
            report, ran_s=report.cycles_sent / self._robot.description.control_rate_hz
        )
        if self._store is not None and self._path is not None:
            try:
                kept = {name: self._metadata[name] for name in ("task", "motion", "excitation_level")}
                facts = {**kept, **report.to_json()}
                # Reading a long recording takes many seconds: the operator wants to know how the robot is.
                phase = f"passive, {_CHECKING}" if report.passive_confirmed else _CHECKING
                on_beat(Beat(MonotonicClock().now_ns(), 0.0, phase, 0))
                info, episode = self._store.note_episode(self._path, facts)
                if info.excitation is not None:
                    report = dataclasses.replace(report, motion=Excitation(**info.excitation))
                if episode is not None:
                    report = dataclasses.replace(
                        report,
                        walk=self._walk(episode.trajectory),
                        balance=self._balance(episode.trajectory),
                        replay=self._replayed(episode.trajectory),
                    )
            except (DealHwError, OSError) as err:
                # Such as a full disk. The report matters more, and the next open indexes the recording.
                report = dataclasses.replace(report, warnings=(*report.warnings, str(err)))
        return report

    def stop(self, cause: str) -> None:
        """Make the robot passive and end the episode, or one that begins later; safe from another thread."""
        self._stop_cause = cause
        if self._supervisor is not None:
            self._supervisor.stop(cause)

    def _walk(self, trajectory: Trajectory) -> VelocityError | None:
        """Return how well the robot followed the requested velocity, by its own sensors."""
        if not robot_entry(self._plan.robot).odometry:
            return None
        from deal_hw.motions.scores.velocity_error import velocity_error, wanted_velocity

        wanted, track = wanted_velocity(trajectory), walked(self._plan.robot, trajectory)
        return None if wanted is None or track is None else velocity_error(track, wanted)

    def _balance(self, trajectory: Trajectory) -> BalanceResult | None:
        """Return how well a policy held the pole up."""
        if self._plan.motion != "balance":
            return None
        return balanced(self._plan.robot, trajectory)

    def _replayed(self, trajectory: Trajectory) -> ReplayError | None:
        """Return the distance of a replay's motion from the recorded one."""
        if self._plan.motion != "replay":
            return None
        from deal_hw.motions.scores.replay_error import replay_error

        before_s = self._plan.posture.before_s if self._plan.stand else 0.0
        recorded, replayed = read_trajectory(Path(self._plan.recording)), trajectory
        return replay_error(followed_part(recorded), followed_part(replayed), before_s)

    def _make_passive(
        self, supervisor: Supervisor, phase: str, already_tried: bool, on_beat: Callable[[Beat], None]
    ) -> bool:
        """Make the robot passive if a dead control process had begun to command it."""
        if self._plan.dry_run:
            return True
        clock = MonotonicClock()

        def tell(text: str, silence_s: float) -> None:
            supervisor.promise(silence_s)
            on_beat(Beat(clock.now_ns(), silence_s, f"{MAKING_PASSIVE}: {text}", 0))

        if supervisor.was_away and (who := self._robot.other_commander(OTHERS_S)):
            self._say(f"not made passive after this program was stopped: {who}")
            return False
        config = _TRIED_AGAIN if already_tried else PassiveConfig(timeout_s=self._plan.passive_timeout_s)
        return passive_after(phase, self._robot, clock, config, tell)


_LINK_WARNING = 0.01
"""Share of corrupt and missing state frames above which the operator gets a warning."""


def account(
    end: ChildEnd, path: Path | None, if_cut: str, local: bool = False, spoilt: bool = False
) -> EpisodeReport:
    """Return the report on an episode from the ends of its processes.

    Args:
        end: How both ended.
        path: The recording.
        if_cut: What the robot does without a connection, as a sentence.
        local: The robot is a program on this computer.
        spoilt: It says that it spoils frames on purpose.
    """
    result = end.result or {}
    outcome, reason, error = _verdict(end, result)
    warnings = list(result.get("warnings", ()))
    if not end.passive_confirmed:
        warnings.append(f"the robot did not confirm that it is passive: switch it off by hand. {if_cut}")
    loop_timing = LoopTimingReport.from_json(result["loop_timing"]) if result.get("loop_timing") else None
    if loop_timing is not None and loop_timing.transport_errors > _LINK_WARNING * max(loop_timing.states, 1):
        share = loop_timing.transport_errors / (loop_timing.states + loop_timing.transport_errors)
        warnings.append(
            f"{loop_timing.transport_errors} transport errors, {share:.0%} of the state frames: "
            f"{corrupt_advice(local, Load.now(), spoilt)}"
        )
    flags = tuple(result.get("flags", ()))
    if outcome is Outcome.TRIPPED and LATE.intersection(flags):
        warnings.append(late_advice(local, Load.now()))
    if end.recorder is not None and not end.recorder.complete:
        why = "; ".join(end.recorder.errors) or "for an unknown reason"
        warnings.append(f"the recording is incomplete ({why}); repair it with `deal-hw data repair {path}`")
        if outcome is Outcome.FINISHED:
            outcome, reason, error = Outcome.FAILED, f"the recorder failed: {why}", "DatasetError"
    return EpisodeReport(
        path=path,
        outcome=outcome,
        reason=reason,
        passive_confirmed=end.passive_confirmed,
        loop_timing=loop_timing,
        clipped=dict(result.get("clipped", {})),
        cycles_sent=int(result.get("cycles_sent", 0)),
        states_recorded=end.recorder.states if end.recorder is not None else 0,
        warnings=tuple(warnings),
        error=error,
        flags=flags,
    )


def _verdict(end: ChildEnd, result: dict[str, Any]) -> tuple[Outcome, str, str]:
    """Return the outcome, its reason as text, and the error's class."""
    operator = bool(end.signal) or end.stop_cause in (OPERATOR, ASLEEP)
    if end.killed and not operator:
        return Outcome.FAILED, f"the control process was killed: {end.killed}", "SafetyError"
    if end.stop_cause and not operator:
        return Outcome.FAILED, end.stop_cause, "DatasetError"
    if result:
        # The control process knows the signal that asked it to end, and not always why it was sent.
        reason = end.stop_cause or OPERATOR if result["reason"] == OPERATOR else result["reason"]
        return Outcome(result["outcome"]), reason, result["error"]
    if operator:
        return Outcome.STOPPED, end.stop_cause, ""
    code = end.exit_code
    how = f"by signal {-code} ({name(-code)})" if code < 0 else f"with exit code {code}"
    return Outcome.FAILED, f"the control process died {how} without a report", "SafetyError"
