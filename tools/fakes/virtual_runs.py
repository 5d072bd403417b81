"""Records runs of a driver in front of an emulated robot, in virtual time."""

from __future__ import annotations

from pathlib import Path

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.robot import Robot
from deal_hw.workflows.running.plan import RunPlan, make_behaviour


def record_run(robot: Robot, clock: VirtualClock, dataset: Dataset, plan: RunPlan) -> Path:
    """Record a run that must finish as the next episode of a dataset; return its file."""
    path, description = dataset.next_episode_path(), robot.description
    with EpisodeRecorder(path, description.to_json(), {"profile": plan.motion}, clock) as recorder:

        def sink(cycle: CycleRecord) -> bool:
            recorder.write(cycle)
            return True

        behaviour = make_behaviour(plan, description)
        config = LoopConfig(duration_s=plan.seconds)
        report = ControlLoop(robot, behaviour, Safety(description), clock, sink, config).run()
    assert report.outcome is Outcome.FINISHED, report.reason
    dataset.note_episode(path)
    return path
