"""Episodes of a user's robot in simulation: the same loop, safety filter and recorder, in virtual time."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.data.files import write_json
from deal_hw.data.recording.excitation import Excitation
from deal_hw.data.recording.record import CycleRecord
from deal_hw.errors import MissingExtraError
from deal_hw.version import __version__
from deal_hw.workflows.robot import default_space, user_robot
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.running.report import EpisodeReport, RunReport
from deal_hw.workflows.running.settings import SimulationOptions
from deal_hw.workflows.running.supervised import InterruptedRunError, play_episodes
from deal_hw.workflows.running.view import RunView

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.sim.robots.simulated import SimulatedRobot

_START_NS = 1_000_000_000_000


def run_simulated(
    plan: RunPlan,
    robot: str,
    options: SimulationOptions,
    *,
    dataset: Path,
    episodes: int,
    purpose: str,
    view: RunView,
    attempts: int = 1,
) -> RunReport:
    """Run episodes on a simulated robot and record them in a dataset with its robot.yaml.

    Args:
        plan: The run; each episode adds its number to the seed.
        robot: A robot.yaml, or a dataset with one.
        options: The hidden truth.
        dataset: Folder of the dataset, made or extended.
        episodes: Number of episodes.
        purpose: For the metadata.
        view: Shows messages.
        attempts: Most recordings of an episode of the motion `rich`.

    Raises:
        DealHwError: The robot cannot be used, or an episode failed.
        InterruptedRunError: Ctrl-C; the recordings are complete.
    """
    try:
        from deal_hw.data.recording.dataset import Dataset
        from deal_hw.sim.engine.model import load_model
        from deal_hw.sim.robots.dataset_robot import store_robot
        from deal_hw.sim.robots.simulated import SimulatedRobot, draw_truth
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "sim") from err

    own = user_robot(robot)
    description = own.description()
    description.require_actuators()
    space = default_space(description)
    truth = draw_truth(space, options.truth_seed, options.truth_ratio, options.truth_latency)
    # Errors of robot or motion must be reported before anything is written.
    SimulatedRobot(load_model(description), space, truth, VirtualClock(_START_NS))
    make_behaviour(plan, description)
    reports: list[EpisodeReport] = []
    with Dataset.create_or_open(dataset, description, view.warn) as store:
        store_robot(own, dataset)

        def run_one(episode: RunPlan, number: int, attempt: int) -> EpisodeReport:
            clock = VirtualClock(_START_NS)
            fresh = dataclasses.replace(truth, seed=truth.seed + 1000 * number + attempt)
            device = SimulatedRobot(load_model(description), space, fresh, clock)
            reports.append(_record(episode, device, clock, store, purpose, attempt))
            view.ended(reports[-1])
            return reports[-1]

        play_episodes(plan, episodes, attempts, description, view, run_one)
    if options.reveal_to is not None:
        write_json(Path(options.reveal_to), truth.to_json())
    reports[-1].raise_error()
    report = RunReport(dataset=dataset, episodes=tuple(reports))
    if report.outcome is Outcome.STOPPED:
        # The loop made the robot passive. A program that collects in a loop must end all the same.
        raise InterruptedRunError(report, signal.SIGINT.name)
    return report


def _record(
    plan: RunPlan, robot: SimulatedRobot, clock: VirtualClock, store: Dataset, purpose: str, attempt: int
) -> EpisodeReport:
    from deal_hw.data.recording.recorder import EpisodeRecorder

    description = robot.description
    path = store.next_episode_path()
    metadata = {
        "robot": description.name,
        "description_digest": description.digest(),
        "purpose": purpose,
        "motion": plan.motion,
        "excite": plan.excite,
        "seed": plan.seed,
        "seconds": plan.seconds,
        "excitation_level": plan.excitation_level,
        "attempt": attempt,
        "simulated": True,
        "deal_hw": __version__,
    }
    states = 0
    with EpisodeRecorder(path, description.to_json(), metadata, clock) as recorder:

        def sink(record: CycleRecord) -> bool:
            nonlocal states
            states += len(record.states)
            recorder.write(record)
            return True

        config = LoopConfig(duration_s=plan.seconds, record_wire=False)
        behaviour = make_behaviour(plan, description)
        end = ControlLoop(robot, behaviour, Safety(description), clock, sink, config).run()
    kept = {name: metadata[name] for name in ("motion", "excitation_level", "simulated")}
    report = EpisodeReport(
        path=path,
        outcome=end.outcome,
        reason=end.reason,
        passive_confirmed=end.passive_confirmed,
        clipped=end.clipped,
        cycles_sent=end.cycles_sent,
        states_recorded=states,
        error=end.error,
        flags=end.flags,
    )
    moved = store.note_episode(path, {**kept, **report.to_json()})[0].excitation
    return report if moved is None else dataclasses.replace(report, motion=Excitation(**moved))
