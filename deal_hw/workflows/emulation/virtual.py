"""Emulated robots in virtual time: same bytes, driver, loop and recorder, faster than real time."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.clock import Clock, VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.excitation import excitation
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice, EmulatedDevice, TrueTrajectory
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.excitation.level import ATTEMPTS, ExcitationLevelSearch, shortfalls
from deal_hw.robot import Robot
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.transport import Transport
from deal_hw.types import FloatArray, Trajectory
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

_START_NS = 10**9


@dataclass(frozen=True, slots=True)
class VirtualEpisode:
    """One recording of an emulated robot, with the true states.

    Attributes:
        trajectory: The recording, as read back from its file.
        first_tick: Device tick of the recording's first sample.
        true: True states since the robot was made; none where its device does not keep them.
        report: How the run went.
    """

    trajectory: Trajectory
    first_tick: int
    true: TrueTrajectory
    report: LoopReport

    def true_states(self, episode: SampledEpisode) -> tuple[FloatArray, FloatArray]:
        """Return noise-free positions and velocities at an episode's samples, (T, J) each."""
        rows = np.searchsorted(self.true.tick, self.first_tick + episode.origin + episode.sample)
        rows = np.minimum(rows, len(self.true.tick) - 1)
        return self.true.position[rows], self.true.velocity[rows]


class VirtualCartpole:
    """An emulated cart-pole in virtual time. Each run homes and arms it, and makes it passive at the end.

    Attributes:
        truth: Its hidden parameters, profile and seed.
        clock: The virtual clock.
        device: The emulated device.
        robot: Makes the driver for its wire.

    Args:
        truth: Its hidden parameters, profile and seed.
        device: The emulated device; by default one with a serial port that keeps its true states.
        robot: Makes the driver for its wire.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        device: EmulatedDevice | None = None,
        robot: Callable[[Transport, Clock], Robot] = CartpoleRobot,
    ) -> None:
        self.truth = truth
        self.clock = VirtualClock(_START_NS)
        self.device = device or CartpoleDevice(truth, keep_truth=True)
        self.robot = robot
        self._transport = VirtualTransport(self.device, self.clock)

    @property
    def description(self) -> RobotDescription:
        """The robot's description."""
        return CartpoleRobot.description

    def run(
        self,
        behaviour: Behaviour,
        seconds: float,
        path: Path | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> VirtualEpisode:
        """Run a behaviour and record it.

        Args:
            behaviour: The behaviour.
            seconds: Length of the run [s].
            path: File to write; a temporary one by default.
            metadata: For the recording.
        """
        robot = self.robot(self._transport, self.clock)
        ticks: list[int] = []
        with tempfile.TemporaryDirectory() as folder:
            file = path or Path(folder) / "episode.mcap"
            with EpisodeRecorder(file, self.description.to_json(), metadata or {}, self.clock) as recorder:

                def sink(record: CycleRecord) -> bool:
                    ticks.extend(round(state.device_ns / 1e6) for state in record.states)
                    recorder.write(record)
                    return True

                safety = Safety(self.description)
                config = LoopConfig(duration_s=seconds)
                report = ControlLoop(robot, behaviour, safety, self.clock, sink, config).run()
            trajectory = read_trajectory(file)
        return VirtualEpisode(trajectory, ticks[0], self.device.true_trajectory(), report)


def demonstrate(
    virtual: VirtualCartpole, plan: RunPlan, attempts: int = ATTEMPTS
) -> tuple[VirtualEpisode, ExcitationLevelSearch]:
    """Record the motion `rich`; repeat it stronger or gentler until it finishes and moves enough.

    Args:
        virtual: The robot.
        plan: The run, with the ``excitation_level`` of the first recording.
        attempts: Most recordings.

    Returns:
        The best recording, and how the search for it went.
    """
    search = ExcitationLevelSearch(plan.excitation_level, attempts)
    runs: list[VirtualEpisode] = []
    again = True
    while again:
        behaviour = make_behaviour(
            dataclasses.replace(plan, excitation_level=search.level), virtual.description
        )
        run = virtual.run(behaviour, plan.seconds)
        runs.append(run)
        tripped = "" if run.report.outcome is Outcome.FINISHED else run.report.reason
        again = search.tell(shortfalls(excitation(run.trajectory), virtual.description), tripped)
    return runs[search.best], search
