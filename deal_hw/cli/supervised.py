"""What collect, deploy and replay share: one run under a supervisor, with another behaviour."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deal_hw import __version__, errors
from deal_hw.cli.commander import HOLDS_LAST_COMMAND, claimed, connected, suspend
from deal_hw.cli.keyboard import check_terminal, keys
from deal_hw.cli.run_plan import RunPlan, check_plan
from deal_hw.cli.seconds_bar import seconds_bar
from deal_hw.clock import MonotonicClock
from deal_hw.control.cadence import CadenceReport
from deal_hw.control.handover import (
    CONNECTING,
    HANDING_BACK,
    HOMING,
    LOADING,
    MAKING_PASSIVE,
    RUNNING,
    STARTING,
    Beat,
)
from deal_hw.control.loop import Outcome
from deal_hw.control.passive import PassiveConfig, make_passive
from deal_hw.control.supervisor import OPERATOR, SUSPENDED, ChildEnd, Supervisor
from deal_hw.control.vigor import VigorSearch, shortfalls
from deal_hw.data.excitation import Excitation
from deal_hw.data.recorder_launch import start_recorder
from deal_hw.description import RobotDescription
from deal_hw.drivers import make_robot
from deal_hw.robot import Robot

if TYPE_CHECKING:
    from deal_hw.data.dataset import Dataset

_LINK_WARNING = 0.01
"""Share of corrupt and missing state frames above which the operator is told."""
_IN_VAIN = PassiveConfig(timeout_s=1.0)
"""Where the control process tried for its whole time, the supervisor's own path gets this chance."""
_EXIT_CODES = {Outcome.FINISHED: 0, Outcome.TRIPPED: 3, Outcome.FAILED: 2, Outcome.STOPPED: 130}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeReport:
    """How one episode went.

    Attributes:
        path: The recording; None where nothing was recorded.
        outcome: How it ended.
        reason: In words.
        passive_confirmed: Whether the robot itself confirmed that it is passive.
        cadence: How regular the control loop was; None where it never ran or was killed.
        clipped: Cycles in which each limit changed a command, by limit.
        cycles_sent: Commands sent.
        states_recorded: State samples in the file.
        warnings: What the operator should know.
        error: Name of the error's class where it failed.
        motion: How much the recording moves; None where nothing was recorded.
    """

    path: Path | None
    outcome: Outcome
    reason: str
    passive_confirmed: bool
    cadence: CadenceReport | None
    clipped: dict[str, int]
    cycles_sent: int
    states_recorded: int
    warnings: tuple[str, ...]
    error: str = ""
    motion: Excitation | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "outcome": self.outcome.value, "reason": self.reason, "passive_confirmed": self.passive_confirmed,
            "cadence": self.cadence.to_json() if self.cadence is not None else None, "clipped": self.clipped,
            "cycles_sent": self.cycles_sent, "states_recorded": self.states_recorded,
            "warnings": list(self.warnings), "error": self.error,
        }  # fmt: skip

    def raise_error(self) -> None:
        """Raise the error that ended the episode, as the class that it was in the control process."""
        if self.outcome is not Outcome.FAILED:
            return
        kind = getattr(errors, self.error, errors.DealHwError)
        if not issubclass(kind, errors.DealHwError) or kind in (
            errors.UnknownNameError,
            errors.MissingExtraError,
        ):
            kind = errors.DealHwError
        raise kind(self.reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """How a run of episodes went.

    Attributes:
        dataset: The dataset's folder; None where nothing was recorded.
        episodes: The episodes, in order; the last is the one that did not finish, if any.
    """

    dataset: Path | None
    episodes: tuple[EpisodeReport, ...]

    @property
    def outcome(self) -> Outcome:
        """How the last episode ended."""
        return self.episodes[-1].outcome

    @property
    def exit_code(self) -> int:
        """For the shell: 0 finished, 2 failed, 3 tripped by the safety module, 130 stopped."""
        return _EXIT_CODES[self.outcome]


class InterruptedRunError(KeyboardInterrupt):
    """The operator ended the program (Ctrl-C, SIGTERM, Ctrl-Z) in a run; the robot was made passive first.

    A ``KeyboardInterrupt``, so that loops over runs end, too, and the program with 130.

    Attributes:
        report: How the runs went until then.
        signal: Name of the signal, such as "SIGINT".
    """

    def __init__(self, report: RunReport, signal: str) -> None:
        super().__init__(report.episodes[-1].reason)
        self.report, self.signal = report, signal


def _ignore(beat: Beat) -> None:
    return


def _both(first: Callable[[Beat], None], second: Callable[[Beat], None]) -> Callable[[Beat], None]:
    def on_beat(beat: Beat) -> None:
        first(beat)
        second(beat)

    return on_beat


def dataset_folder(out: Path | None, dataset: Path | None, *, required: bool = True) -> Path | None:
    """Return the dataset's folder from the options --out and --dataset.

    Raises:
        ConfigurationError: Both were given, or neither where one is required.
    """
    if out is not None and dataset is not None:
        raise errors.ConfigurationError("give --out RUN or --dataset DIR, not both")
    if out is None and dataset is None and required:
        raise errors.ConfigurationError("give --out RUN (the episodes go to RUN/dataset) or --dataset DIR")
    return out / "dataset" if out is not None else dataset


def run_episodes(
    plan: RunPlan,
    *,
    port: str,
    dataset: Path | None,
    episodes: int,
    purpose: str,
    task: str = "",
    quiet: bool = False,
    on_beat: Callable[[Beat], None] = _ignore,
    attempts: int = 1,
) -> RunReport:
    """Run episodes one after the other on one port, each in a control process of its own.

    Args:
        plan: What to do; each episode adds its number to the seed.
        port: The port.
        dataset: Folder of the dataset, made or extended; None to record nothing.
        episodes: How many.
        purpose: "collect", "deploy" or "replay", for the metadata.
        task: For the metadata.
        quiet: Whether to print nothing.
        on_beat: Called with each heartbeat of the control process, in the thread that waits for it.
        attempts: How often an episode of the profile `rich` is recorded at most, livelier each time, until it
            moves enough; see :mod:`deal_hw.control.vigor`.

    Raises:
        DealHwError: What made it fail, after the robot was made passive and the recording closed.
        InterruptedRunError: The operator ended the program.
    """
    if episodes < 1:
        raise errors.ConfigurationError(f"--episodes {episodes}: at least 1")
    plan = dataclasses.replace(plan, port=port)
    if plan.velocity == "keyboard":
        check_terminal()
    robot = make_robot(
        plan.robot, plan.transport, port, MonotonicClock(), plan.wire, plan.robot_settings,
        can_send=not plan.dry_run,
    )  # fmt: skip
    # Whatever is wrong with settings, policy or recording should be said before anybody touches the robot.
    VigorSearch(plan.vigor, attempts)
    plan = check_plan(plan, robot.description)
    reports: list[EpisodeReport] = []
    if not robot.watchdog_s and not plan.dry_run and not quiet:
        print(HOLDS_LAST_COMMAND.format(robot=plan.robot), file=sys.stderr)
    # The supervisor connects to the robot itself, so that a wrong port is known before a process is started.
    # From then on it only keeps the port, until the control process is dead.
    with (
        _suspended_last(),
        claimed(plan) as claim,
        connected(robot),
        _open_dataset(dataset, robot.description) as store,
    ):
        for number in range(episodes):
            # The robot's own controller gets it back after the last episode only.
            last = number == episodes - 1
            episode = dataclasses.replace(plan, seed=plan.seed + number, hand_back=plan.hand_back and last)
            title = f"{purpose} {plan.robot} {number + 1}/{episodes}"
            search = VigorSearch(plan.vigor, attempts, rearm=False)
            again = True
            while again:
                episode = dataclasses.replace(episode, vigor=search.vigor)
                run = _Episode(episode, robot, port, store, purpose, task, len(search.attempts), claim)
                with contextlib.nullcontext(_ignore) if quiet else _progress(title, plan.total_s) as show:
                    reports.append(run.run(_both(show, on_beat)))
                if not quiet:
                    print_report(reports[-1])
                if run.signal:
                    report = RunReport(dataset=dataset, episodes=tuple(reports))
                    raise InterruptedRunError(report, run.signal)
                again = _to_repeat(search, episode, reports[-1], robot.description)
                if search.words:
                    print(f"warning: {search.words}", file=sys.stderr)
            if reports[-1].outcome is not Outcome.FINISHED:
                break
    reports[-1].raise_error()
    return RunReport(dataset=dataset, episodes=tuple(reports))


@contextlib.contextmanager
def _suspended_last() -> Iterator[None]:
    """Stop for Ctrl-Z only when all is given back: a stopped program must hold neither claim nor wire."""
    try:
        yield
    except InterruptedRunError as interrupted:
        if interrupted.signal == signal.SIGTSTP.name:
            suspend()
        raise


def _to_repeat(
    search: VigorSearch, plan: RunPlan, report: EpisodeReport, description: RobotDescription
) -> bool:
    """Say whether an episode is recorded again, at the search's new vigor; its words tell why."""
    judged = report.outcome in (Outcome.FINISHED, Outcome.TRIPPED) and report.motion is not None
    if plan.profile != "rich" or not judged or plan.dry_run or description.floating_base is not None:
        return False
    tripped = report.reason if report.outcome is Outcome.TRIPPED else ""
    return report.motion is not None and search.tell(shortfalls(report.motion, description), tripped)


@contextlib.contextmanager
def _open_dataset(folder: Path | None, description: RobotDescription) -> Iterator[Dataset | None]:
    if folder is None:
        yield None
        return
    from deal_hw.data.dataset import Dataset

    with Dataset.create_or_open(folder, description, lambda text: print(text, file=sys.stderr)) as store:
        yield store


class _Episode:
    """One episode: a recorder, a control process and the account of both."""

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
    ) -> None:
        self._keep_fds = keep_fds
        self.signal = ""
        """Name of the signal by which the operator ended it; "" where there was none."""
        self._plan, self._robot, self._port, self._store = plan, robot, port, store
        self._path = store.next_episode_path() if store is not None else None
        self._metadata = {
            "robot": plan.robot,
            "description_digest": robot.description.digest(),
            "purpose": purpose,
            "task": task,
            "profile": plan.profile,
            "policy": plan.policy,
            "policy_digest": plan.policy_digest[:16],
            "recording": plan.recording,
            "excite": plan.excite,
            "seed": plan.seed,
            "seconds": plan.seconds,
            "vigor": plan.vigor,
            "attempt": attempt,
            "dry_run": plan.dry_run,
            "velocity": plan.velocity,
            "stand": plan.stand,
            "deal_hw": __version__,
        }

    def run(self, on_beat: Callable[[Beat], None]) -> EpisodeReport:
        """Run it and return the account."""
        recorder = None
        if self._path is not None:
            recorder = start_recorder(self._path, self._robot.description.to_json(), self._metadata)
            try:
                recorder.wait_ready()
            except BaseException:
                recorder.finish()
                raise
        port_fd = self._robot.fileno()
        supervisor = Supervisor(
            module="deal_hw.cli.control_process",
            plan=self._plan.to_json(),
            port_fd=port_fd if port_fd >= 0 else None,
            passive=lambda phase, in_vain: self._make_passive(phase, in_vain, supervisor, on_beat),
            recorder=recorder,
            on_beat=on_beat,
            keep_fds=self._keep_fds,
        )
        listening = (
            keys(supervisor.tell, lambda: supervisor.stop(OPERATOR))
            if self._plan.velocity == "keyboard"
            else contextlib.nullcontext()
        )
        with listening:
            end = supervisor.run()
        self.signal = end.signal
        report = account(end, self._path, self._robot.watchdog_s)
        if self._store is not None and self._path is not None:
            try:
                facts = {"task": self._metadata["task"], **report.to_json()}
                moved = self._store.note_episode(self._path, facts).excitation
                if moved is not None:
                    report = dataclasses.replace(report, motion=Excitation(**moved))
            except (errors.DealHwError, OSError) as err:
                # As on a full disk. The report matters more, and the next open takes the recording in.
                report = dataclasses.replace(report, warnings=(*report.warnings, str(err)))
        return report

    def _make_passive(
        self, phase: str, in_vain: bool, supervisor: Supervisor, on_beat: Callable[[Beat], None]
    ) -> bool:
        """Make the robot passive for a dead control process, where that one had set out to command it."""
        untouched = (
            STARTING,
            LOADING,
            CONNECTING,
            HANDING_BACK,
            *(() if self._robot.homes_by_motor else (HOMING,)),
        )
        if self._plan.dry_run or phase in untouched:
            return True
        clock = MonotonicClock()

        def tell(text: str, silence_s: float) -> None:
            on_beat(Beat(clock.now_ns(), silence_s, f"{MAKING_PASSIVE}: {text}", 0))

        config = _IN_VAIN if in_vain else PassiveConfig(timeout_s=self._plan.passive_timeout_s)
        return make_passive(self._robot, clock, config, progress=tell, abandoned=lambda: supervisor.abandoned)


def account(end: ChildEnd, path: Path | None, watchdog_s: float) -> EpisodeReport:
    """Return how an episode went from how its processes ended.

    Args:
        end: That.
        path: The recording; None where there is none.
        watchdog_s: ``Robot.watchdog_s``.
    """
    result = end.result or {}
    outcome, reason, error = _verdict(end, result)
    warnings = list(result.get("warnings", ()))
    if not end.passive_confirmed:
        cut = (
            f"Where the cable is cut, its own watchdog has stopped the motor after {watchdog_s:g} s"
            if watchdog_s
            else "Where the link is gone it still holds its last command, with stiff motors: use its remote "
            "(damping), then its switch"
        )
        warnings.append(f"the robot did not confirm that it is passive: switch it off by hand. {cut}")
    cadence = CadenceReport.from_json(result["cadence"]) if result.get("cadence") else None
    if cadence is not None and cadence.link_errors > _LINK_WARNING * max(cadence.states, 1):
        share = cadence.link_errors / (cadence.states + cadence.link_errors)
        warnings.append(
            f"{cadence.link_errors} link errors, {share:.0%} of the state frames: "
            "check cable, connectors and grounding"
        )
    if end.recorder is not None and not end.recorder.complete:
        why = "; ".join(end.recorder.errors) or "for an unknown reason"
        warnings.append(f"the recording is incomplete ({why}); mend it with `deal-hw data repair {path}`")
        if outcome is Outcome.FINISHED:
            outcome, reason, error = Outcome.FAILED, f"the recorder failed: {why}", "DatasetError"
    return EpisodeReport(
        path=path,
        outcome=outcome,
        reason=reason,
        passive_confirmed=end.passive_confirmed,
        cadence=cadence,
        clipped=dict(result.get("clipped", {})),
        cycles_sent=int(result.get("cycles_sent", 0)),
        states_recorded=end.recorder.states if end.recorder is not None else 0,
        warnings=tuple(warnings),
        error=error,
    )


def _verdict(end: ChildEnd, result: dict[str, Any]) -> tuple[Outcome, str, str]:
    """Return outcome, reason in words and the error's class."""
    operator = end.stop_cause in (OPERATOR, SUSPENDED)
    if end.killed and not operator:
        return Outcome.FAILED, f"the control process was killed: {end.killed}", "SafetyError"
    if end.stop_cause and not operator:
        return Outcome.FAILED, end.stop_cause, "DatasetError"
    if result:
        return Outcome(result["outcome"]), result["reason"], result["error"]
    if operator:
        return Outcome.STOPPED, end.stop_cause, ""
    code = end.exit_code
    how = f"by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"with exit code {code}"
    return Outcome.FAILED, f"the control process died {how} without a report", "SafetyError"


def print_report(report: EpisodeReport) -> None:
    """Print an account for the operator."""
    print(f"{report.outcome.value}: {report.reason}")
    if report.cadence is not None:
        print("\n".join("  " + line for line in report.cadence.lines()))
    for limit, cycles in report.clipped.items():
        print(f"  clipped by the safety filter: {limit} in {cycles} cycles")
    if report.path is not None:
        print(f"  recorded {report.states_recorded} states in {report.path}")
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)


@contextlib.contextmanager
def _progress(title: str, seconds: float) -> Iterator[Callable[[Beat], None]]:
    """Show a progress bar on a terminal; everywhere, each second, trouble in making the robot passive."""
    with seconds_bar(title, seconds) as bar:
        started_ns = 0
        trouble = ""

        def on_beat(beat: Beat) -> None:
            nonlocal started_ns, trouble
            if beat.phase.startswith(f"{MAKING_PASSIVE}: ") and beat.phase != trouble:
                trouble = beat.phase
                print(f"{title}: {trouble}", file=sys.stderr, flush=True)
            if beat.phase != RUNNING:
                bar.say(f"{title}: {beat.phase}")
                return
            if not started_ns:
                started_ns = beat.stamp_ns
                bar.say(title)
            if beat.count % 10 == 0:
                bar.passed((beat.stamp_ns - started_ns) * 1e-9)

        yield on_beat
