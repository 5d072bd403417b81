"""Real processes and a real network: unitree_mujoco's stand-in stands up, lies down and ends damped."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fakes.unitree_mujoco import PUBLISHED, SUBSCRIBED, UnitreeMujoco

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import SafetyError, TransportTimeoutError, VersionMismatchError
from deal_hw.motions.posture import PostureConfig
from deal_hw.robots.connect import make_topic_transport
from deal_hw.transport import Message, WireOptions
from deal_hw.workflows.emulation.topics import free_port
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.supervised import run_episodes
from deal_hw.workflows.running.view import RunView

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

PLAN = RunPlan(
    robot="go2",
    transport="zenoh",
    motion="hold",
    seconds=1.0,
    stand=True,
    posture=PostureConfig(fold_s=0.4, rise_s=0.8, settle_s=0.2, lie_s=0.8),
    robot_settings={"simulator": "unitree_mujoco"},
)


@pytest.fixture
def simulator() -> Iterator[tuple[str, UnitreeMujoco]]:
    """The port of a stand-in that runs in real time, and the stand-in."""
    clock, stop = MonotonicClock(), threading.Event()
    port = free_port("tcp/127.0.0.1:0")
    device = UnitreeMujoco(np.array(DRIVER.rest_position))
    wire = make_topic_transport("zenoh", port, clock, WireOptions(listen=True))
    wire.declare(publish=PUBLISHED, subscribe=SUBSCRIBED)

    def live() -> None:
        origin_ns = clock.now_ns()
        while not stop.is_set():
            clock.sleep_until_ns(origin_ns + device.device_ns)
            with contextlib.suppress(TransportTimeoutError):
                while True:
                    message = wire.receive(0.0)
                    device.receive(message.channel, message.payload)
            for topic, payload in device.tick():
                wire.send(Message(topic, payload, clock.now_ns()))

    thread = threading.Thread(target=live)
    with wire:
        thread.start()
        try:
            yield port, device
        finally:
            stop.set()
            thread.join()


def test_a_run_ends_with_next_to_no_torque(tmp_path: Path, simulator: tuple[str, UnitreeMujoco]) -> None:
    """Supervisor, control process and recorder: the limits are the robot's, what is missing is named once."""
    port, device = simulator
    printed: list[str] = []
    view = RunView(printed.append)
    for attempt in range(3):
        folder = tmp_path / f"dataset_{attempt}"
        try:
            report = run_episodes(PLAN, port=port, dataset=folder, episodes=1, purpose="collect", view=view)
        except SafetyError as error:
            # A machine that holds the simulator up makes states old: the limit is the robot's.
            if attempt == 2 or not ("old" in str(error) or "no heartbeat" in str(error)):
                raise
            continue
        break
    (episode,) = report.episodes
    assert episode.outcome is Outcome.FINISHED
    assert np.abs(device.torque).max() < 0.6
    assert device.command is not None and not device.command.stiffness.any()
    assert sum("the simulator unitree_mujoco" in line for line in printed) == attempt + 1
    with Dataset.open(folder) as dataset:
        thigh = dataset.read(0).trajectory.position[:, 1]
    assert thigh.min() < 1.0 < thigh.max()


def test_the_simulator_is_not_taken_for_a_robot(simulator: tuple[str, UnitreeMujoco]) -> None:
    """Without the option, nothing is sent to it."""
    port, device = simulator
    plan = RunPlan(robot="go2", transport="zenoh", motion="hold", seconds=1.0)
    with pytest.raises(VersionMismatchError, match="--simulator unitree_mujoco"):
        run_episodes(plan, port=port, dataset=None, episodes=1, purpose="collect")
    assert device.commands == 0
