"""Records runs of a driver in front of an emulated robot, in virtual time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.excitation.behaviours import RichConfig
from deal_hw.robot import Robot
from deal_hw.types import NOT_FOLLOWING, Event
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

Motion = Literal["rich", "chirp", "hold"]


def record_run(
    robot: Robot,
    clock: VirtualClock,
    dataset: Dataset,
    plan: RunPlan,
    facts: Mapping[str, Any] | None = None,
    noted: Callable[[CycleRecord], tuple[Event, ...]] = lambda cycle: (),
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Record a run that must finish as the next episode of a dataset; return its file.

    Args:
        robot: The robot.
        clock: Its clock.
        dataset: The dataset.
        plan: The run.
        facts: To keep with the episode, such as another outcome.
        noted: Returns events to record with a cycle, beside its own.
        metadata: Of the recording, beside its motion.
    """
    path, description = dataset.next_episode_path(), robot.description
    named = {"profile": plan.motion, **(metadata or {})}
    with EpisodeRecorder(path, description.to_json(), named, clock) as recorder:

        def sink(cycle: CycleRecord) -> bool:
            recorder.write(dataclasses.replace(cycle, events=(*cycle.events, *noted(cycle))))
            return True

        behaviour = make_behaviour(plan, description)
        config = LoopConfig(duration_s=plan.seconds)
        report = ControlLoop(robot, behaviour, Safety(description), clock, sink, config).run()
    assert report.outcome is Outcome.FINISHED, report.reason
    dataset.note_episode(path, facts)
    return path


def record_cartpole(
    folder: Path,
    motion: Motion = "rich",
    seconds: float = 2.6,
    *,
    facts: Mapping[str, Any] | None = None,
    unfollowed_s: float = 0.0,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Record an emulated cart-pole as the next episode of a dataset; return its file.

    Args:
        folder: The dataset; made if missing.
        motion: The motion: rich (without balancing), chirp or hold.
        seconds: Length of the run [s].
        facts: To keep with the episode, such as another outcome.
        unfollowed_s: An event says that the cart does not follow its commands in this time at the end [s].
        metadata: Of the recording, beside its motion.
    """
    clock = VirtualClock(10**9)
    device = CartpoleDevice(nominal_truth("sensor", 4, actuation_ticks=9))
    robot = CartpoleRobot(VirtualTransport(device, clock), clock)
    plan = RunPlan(
        robot="cartpole",
        motion=motion,
        seconds=seconds,
        seed=1,
        rich=RichConfig(duration_s=seconds, balance_s=0.0),
    )
    begin_ns: list[int] = []
    ended: list[Event] = []

    def noted(cycle: CycleRecord) -> tuple[Event, ...]:
        begin_ns.append(cycle.start_ns)
        since_ns = begin_ns[0] + round((seconds - unfollowed_s) * 1e9)
        # A loop is sure some time after the moment that it names.
        if not unfollowed_s or ended or cycle.start_ns < since_ns + 100_000_000:
            return ()
        data = {"since_ns": since_ns, "joints": ["cart"]}
        ended.append(Event(cycle.start_ns, NOT_FOLLOWING, "joint 'cart' does not follow its commands", data))
        return tuple(ended)

    with Dataset.create_or_open(folder, robot.description) as dataset:
        return record_run(robot, clock, dataset, plan, facts, noted, metadata)
