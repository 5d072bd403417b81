"""The run under a supervisor that collect, deploy and replay share, each with its own behaviour."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw import errors
from deal_hw.clock import MonotonicClock
from deal_hw.control.process.channel import Beat, Outcome
from deal_hw.description import RobotDescription
from deal_hw.motions.excitation.level import ExcitationLevelSearch, shortfalls
from deal_hw.ranges import option
from deal_hw.robot import Robot
from deal_hw.robots.connect import make_robot
from deal_hw.workflows.causes import BY_MOTION
from deal_hw.workflows.options import File
from deal_hw.workflows.robot import is_user_robot, keep_robot
from deal_hw.workflows.running.commander import HOLDS_LAST_COMMAND, claimed, connected, noted, suspend
from deal_hw.workflows.running.episode import EpisodeRun
from deal_hw.workflows.running.plan import RunPlan, check_plan
from deal_hw.workflows.running.report import EpisodeReport, RunReport
from deal_hw.workflows.running.sleep_lock import ASLEEP, awake
from deal_hw.workflows.running.view import OnBeat, RunView, ignore
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset


class InterruptedRunError(KeyboardInterrupt):
    """The operator ended a run (Ctrl-C, SIGTERM, Ctrl-Z); the robot was made passive first.

    A ``KeyboardInterrupt``, so that loops over runs end, too, and the exit code is 130.

    Attributes:
        report: The runs until then.
        signal: Name of the signal, such as "SIGINT".
    """

    def __init__(self, report: RunReport, signal: str) -> None:
        super().__init__(report.episodes[-1].reason)
        self.report, self.signal = report, signal


def _both(first: OnBeat, second: OnBeat) -> OnBeat:
    def on_beat(beat: Beat) -> None:
        first(beat)
        second(beat)

    return on_beat


def dataset_folder(out: File | None, dataset: File | None) -> Path:
    """Return the dataset's folder from the options --out and --dataset.

    Raises:
        ConfigurationError: Both were given, or neither.
    """
    if out is not None and dataset is not None:
        raise errors.ConfigurationError("give --out RUN or --dataset DIR, not both")
    if out is not None:
        return Path(out) / "dataset"
    if dataset is None:
        raise errors.ConfigurationError("give --out RUN (the episodes go to RUN/dataset) or --dataset DIR")
    return Path(dataset)


def recording_folder(
    out: File | None, dataset: File | None, purpose: str, robot: str, *, record: bool = True
) -> Path | None:
    """Return the dataset folder of a run with an optional recording; None for no recording.

    Args:
        out: --out.
        dataset: --dataset.
        purpose: "deploy" or "replay"; the default folder is runs/PURPOSE_ROBOT.
        robot: The robot.
        record: Whether to record; with False only a named folder is used.

    Raises:
        ConfigurationError: Both were given.
    """
    if out is None and dataset is None:
        return Path("runs") / f"{purpose}_{robot}" / "dataset" if record else None
    return dataset_folder(out, dataset)


def run_episodes(
    plan: RunPlan,
    *,
    port: str,
    dataset: Path | None,
    episodes: int,
    purpose: str,
    task: str = "",
    view: RunView | None = None,
    on_beat: OnBeat = ignore,
    attempts: int = 1,
) -> RunReport:
    """Run episodes one after the other on one port, each in its own control process.

    Args:
        plan: The run; each episode adds its number to the seed.
        port: The port.
        dataset: Folder of the dataset, made or extended; None to record nothing.
        episodes: Number of episodes.
        purpose: "collect", "deploy" or "replay", for the metadata.
        task: For the metadata.
        view: Shows messages and asks questions; by default none.
        on_beat: Called with each heartbeat of the control process, in the thread that waits for it.
        attempts: Most recordings of an episode of the motion `rich`, each stronger, until it moves enough;
            see :mod:`deal_hw.motions.excitation.level`.

    Raises:
        DealHwError: The run failed; the robot was made passive and the recording closed.
        InterruptedRunError: The operator ended the program.
    """
    view = view or RunView()
    if episodes < 1:
        raise errors.ConfigurationError(f"--episodes {episodes}: give at least 1")
    plan = dataclasses.replace(plan, port=port)
    if plan.velocity == "keyboard":
        from deal_hw.workflows.running.keyboard import check_terminal

        check_terminal()
    robot = make_robot(
        plan.robot,
        plan.transport,
        port,
        MonotonicClock(),
        plan.wire,
        plan.robot_settings,
        can_send=not plan.dry_run,
    )
    # Errors of settings, policy or recording must be reported before the robot is used.
    ExcitationLevelSearch(plan.excitation_level, attempts)
    plan = check_plan(plan, robot.description, view)
    plan = _conditioned(plan, robot, view)
    reports: list[EpisodeReport] = []
    current: list[EpisodeRun] = []
    sleeping = threading.Event()

    def before_sleep() -> None:
        sleeping.set()
        for run in current[-1:]:
            run.stop(ASLEEP)

    holds_last_command = not robot.watchdog_s and not plan.dry_run
    if robot.notice:
        view.note(robot.notice)
    elif holds_last_command:
        view.note(HOLDS_LAST_COMMAND.format(robot=robot.description.name, stopped_by=robot.stopped_by))
    # The supervisor connects to the robot itself, so that a wrong port is reported before a process starts.
    # Then it only keeps the port open, until the control process is dead.
    with (
        _suspended_last(view.warn),
        claimed(plan) as claim,
        noted(plan) as note,
        awake(before_sleep, view.note) if holds_last_command else contextlib.nullcontext(),
        connected(robot),
        _open_dataset(dataset, plan.robot, robot.description, view.warn) as store,
    ):
        if store is not None and plan.policy_digest:
            store.keep_policy(Path(plan.policy), plan.policy_digest)

        def run_one(episode: RunPlan, number: int, attempt: int) -> EpisodeReport:
            run = EpisodeRun(episode, robot, port, store, purpose, task, attempt, claim, view.warn, note)
            current.append(run)
            if sleeping.is_set():
                run.stop(ASLEEP)
            with view.progress(
                f"{purpose} {robot.description.name} {number + 1}/{episodes}", plan.total_s
            ) as show:
                reports.append(run.run(_both(show, on_beat)))
            view.ended(reports[-1])
            if run.signal:
                if reports[-1].outcome is Outcome.FAILED:
                    # The interrupt takes the place of the error that would say it.
                    view.warn(f"warning: {reports[-1].reason}")
                report = RunReport(dataset=dataset, episodes=tuple(reports))
                raise InterruptedRunError(report, run.signal)
            return reports[-1]

        play_episodes(plan, episodes, attempts, robot.description, view, run_one)
    reports[-1].raise_error()
    return RunReport(dataset=dataset, episodes=tuple(reports))


def _conditioned(plan: RunPlan, robot: Robot, view: RunView) -> RunPlan:
    """Return the plan with the operator's word that the robot is as it must be, where no sensor tells.

    Raises:
        SafetyError: The operator says no, or nobody can answer.
    """
    name = robot.condition_setting
    if not robot.condition or plan.dry_run or plan.robot_settings.get(name):
        return plan
    answer = view.confirm(f"{robot.description.name}: {robot.condition}", "is that so?")
    if answer is None:
        raise errors.SafetyError(
            f"{robot.description.name}: {robot.condition}. No sensor tells it: confirm it by {option(name)}"
        )
    if not answer:
        raise errors.SafetyError(f"not run, nothing was sent: {robot.condition}")
    return dataclasses.replace(plan, robot_settings={**plan.robot_settings, name: True})


def play_episodes(
    plan: RunPlan,
    episodes: int,
    attempts: int,
    description: RobotDescription,
    view: RunView,
    run_one: Callable[[RunPlan, int, int], EpisodeReport],
) -> None:
    """Run episodes; repeat those of the motion `rich` stronger until they move enough.

    Args:
        plan: The run; each episode adds its number to the seed.
        episodes: Number of episodes; an unfinished one is the last.
        attempts: Most recordings of an episode.
        description: The robot.
        view: Shows messages.
        run_one: Runs an episode, of the given number (from 0) and attempt.
    """
    for number in range(episodes):
        # The robot returns to its own controller after the last episode only.
        last = number == episodes - 1
        episode = dataclasses.replace(plan, seed=plan.seed + number, hand_back=plan.hand_back and last)
        search = ExcitationLevelSearch(plan.excitation_level, attempts, rearm=False)
        again = True
        while again:
            episode = dataclasses.replace(episode, excitation_level=search.level)
            report = run_one(episode, number, len(search.attempts))
            again = _to_repeat(search, episode, report, description)
            if search.words:
                view.warn(f"warning: {search.words}")
        if report.outcome is not Outcome.FINISHED:
            break


@contextlib.contextmanager
def _suspended_last(say: Say) -> Iterator[None]:
    """Stop for Ctrl-Z only after all is released: a stopped program must hold neither claim nor wire."""
    try:
        yield
    except InterruptedRunError as interrupted:
        if interrupted.signal == signal.SIGTSTP.name:
            suspend(say)
        raise


def _to_repeat(
    search: ExcitationLevelSearch, plan: RunPlan, report: EpisodeReport, description: RobotDescription
) -> bool:
    """Return whether to record an episode again at the search's new excitation level."""
    judged = report.outcome in (Outcome.FINISHED, Outcome.TRIPPED) and report.motion is not None
    if plan.motion != "rich" or not judged or plan.dry_run or description.floating_base is not None:
        return False
    tripped = report.reason if report.outcome is Outcome.TRIPPED else ""
    if tripped and not (report.passive_confirmed and BY_MOTION.intersection(report.flags)):
        # Such as a busy computer, which the report's warnings name: a gentler motion would not help.
        return False
    return report.motion is not None and search.tell(shortfalls(report.motion, description), tripped)


@contextlib.contextmanager
def _open_dataset(
    folder: Path | None, robot: str, description: RobotDescription, say: Say
) -> Iterator[Dataset | None]:
    if folder is None:
        yield None
        return
    from deal_hw.data.recording.dataset import Dataset

    with Dataset.create_or_open(folder, description, say) as store:
        if is_user_robot(robot):
            keep_robot(robot, folder)
        yield store
