"""The emulated Go2 in virtual time: same bytes, driver, loop and recorder, with its true positions."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.reader import read_episode
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.motions.planned_end import PlannedEnd
from deal_hw.motions.posture import PostureBehaviour, PostureConfig, limited_for
from deal_hw.motions.scores.velocity_error import VELOCITY_EVENT, Track, Wanted, velocity_data, wanted_in
from deal_hw.motions.velocity import HeldHeading, NotedVelocity, SlowedVelocity, VelocitySource
from deal_hw.policy import Policy
from deal_hw.sim.legged.terrain import Terrain
from deal_hw.types import Event, FloatArray, Trajectory

_START_NS = 10**9


class _Watched:
    """The emulated robot, with its base's position at each tick."""

    def __init__(self, device: Go2Device) -> None:
        self._device = device
        self.rows: list[tuple[float, ...]] = []

    @property
    def device_ns(self) -> int:
        return self._device.device_ns

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        self._device.receive(topic, payload, stamp_ns)

    def tick(self) -> list[tuple[str, bytes]]:
        device = self._device
        x, y, _ = device.base_position
        self.rows.append((device.device_ns * 1e-9, float(x), float(y), device.heading, device.tilt))
        return device.tick()


@dataclass(frozen=True, slots=True, eq=False)
class VirtualWalk:
    """One walk.

    Attributes:
        report: How the run went.
        trajectory: The recording, as read back from its file; None without a recording.
        wanted: The requested velocities, on the robot's clock; None if the policy never began.
        track: True positions of the base, on the robot's clock.
        tilt: True angle between the base's z axis and the vertical, at the track's times, (T,) [rad].
    """

    report: LoopReport
    trajectory: Trajectory | None
    wanted: Wanted | None
    track: Track
    tilt: FloatArray


def walk(
    truth: Go2Truth,
    policy: Policy,
    source: VelocitySource,
    seconds: float,
    path: Path | None = None,
    metadata: Mapping[str, Any] | None = None,
    *,
    record: bool = True,
    end: PlannedEnd | None = None,
    terrain: Terrain | None = None,
    obstacle: tuple[float, float] = (0.0, 0.0),
    hold_heading: bool = False,
) -> VirtualWalk:
    """Make a new robot stand up, walk, come to a stand and lie down.

    Args:
        truth: Its hidden parameters, profile and seed.
        policy: The walking policy.
        source: Source of the requested velocity.
        seconds: Duration of the walk [s].
        path: File to write; a temporary one by default.
        metadata: For the recording.
        record: Whether to record; recording takes a third of the time.
        end: Takes requests for an earlier end.
        terrain: What is ahead of the robot; None for a flat floor.
        obstacle: What a policy that climbs is told of it: distance and height [m].
        hold_heading: Whether the requested turn is corrected by the robot's inertial sensor.
    """
    clock = VirtualClock(_START_NS)
    watched = _Watched(Go2Device(truth, terrain=terrain))
    wanted_events: list[Event] = []

    def note(velocity: FloatArray) -> None:
        loop.note(VELOCITY_EVENT, "wanted velocity", **velocity_data(velocity))
        wanted_events.append(Event(watched.device_ns, VELOCITY_EVENT, "", velocity_data(velocity)))

    noted: VelocitySource = NotedVelocity(source, note)
    slowed = SlowedVelocity(HeldHeading(noted) if hold_heading else noted)
    inner = PolicyBehaviour(policy, DRIVER, slowed, obstacle=obstacle)
    whole = PostureBehaviour(inner, DRIVER, seconds, PostureConfig(), slowed=slowed, end=end)
    trajectory = None
    with contextlib.ExitStack() as folder, contextlib.ExitStack() as recording:

        def keep(one: CycleRecord) -> bool:
            if record:
                recorder.write(one)
            return True

        if record:
            file = path or Path(folder.enter_context(tempfile.TemporaryDirectory())) / "episode.mcap"
            recorder = EpisodeRecorder(file, DRIVER.to_json(), metadata or {}, clock)
            recording.enter_context(recorder)
        robot = Go2Robot(VirtualTopics(watched, clock), clock)
        config = LoopConfig(duration_s=whole.longest_s)
        safety = Safety(limited_for(whole, DRIVER))
        loop = ControlLoop(robot, whole, safety, clock, keep, config, end=whole.end)
        report = loop.run()
        recording.close()
        if record:
            trajectory = read_episode(file).trajectory
    rows = np.array(watched.rows)
    track = Track(rows[:, 0], rows[:, 1:3], rows[:, 3])
    return VirtualWalk(report, trajectory, wanted_in(wanted_events, 0, seconds), track, rows[:, 4])
