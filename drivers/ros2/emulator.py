"""``deal-hw emulate robot.yaml`` of a robot of ros2_control: its topics in real time, with hidden physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from deal_hw.clock import MonotonicClock
from deal_hw.description import RobotDescription
from deal_hw.drivers.ros2.connect import make_link
from deal_hw.drivers.ros2.device import Ros2Device
from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.drivers.transports.topic_emulator import TopicEmulator
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space
from deal_hw.testing.faults import FaultRates
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.transport import TopicTransport

PORTS: Final = {"dds": "127.0.0.1", "zenoh": "tcp/127.0.0.1:7447"}
"""Where an emulator is by default, by wire: on this machine only."""


def ros2_device(
    section: Ros2Section,
    description: RobotDescription,
    truth: SimulatedTruth,
    *,
    noisy: bool = True,
    rates: FaultRates | None = None,
    joint_faults: JointFaults | None = None,
    faults: ControllerFaults | None = None,
) -> Ros2Device:
    """Return an emulated robot.

    Args:
        section: The controller and the topics.
        description: The robot.
        truth: Hidden parameters.
        noisy: Whether positions have the noise of the description.
        rates: Faults of the joint states on the wire.
        joint_faults: Faults of the joints.
        faults: Faults of the controller.
    """
    robot, space = load_model(description), default_space(description)
    return Ros2Device(
        section,
        robot,
        space,
        truth,
        noisy=noisy,
        rates=rates,
        joint_faults=joint_faults,
        faults=faults,
    )


class Ros2Emulation(TopicEmulator):
    """An emulated robot on its network; see :class:`~deal_hw.robots.emulation.Emulation`.

    Args:
        device: The device.
        transport: Its wire; not opened yet.
        section: The topics.
        cut_after_s: The wire is cut so long after the first command; None: never [s].
        cut_s: How long it is cut [s].
        freeze_after_s: The controller_manager stops so long after the first command; None: never [s].
    """

    def __init__(
        self,
        device: Ros2Device,
        transport: TopicTransport,
        section: Ros2Section,
        *,
        cut_after_s: float | None = None,
        cut_s: float = 1.0,
        freeze_after_s: float | None = None,
    ) -> None:
        topics = topics_of(section)
        super().__init__(device, transport, [topics.states, topics.activity], [topics.commands])
        self._robot, self._cut_s = device, cut_s
        self._cut_after_s, self._freeze_after_s = cut_after_s, freeze_after_s
        self._begun_ns: int | None = None

    @property
    def changes(self) -> Sequence[tuple[int, int, str]]:
        """What happened so far: device time [ms], host time [ns] and the event."""
        return self._robot.changes

    def cut(self) -> None:
        """Cut the wire for a while."""
        self._robot.cut(self._cut_s)

    def step(self) -> bool:
        """Serve the topics for one tick; begin the faults that are due."""
        going_on = super().step()
        if self._robot.accepted and self._begun_ns is None:
            self._begun_ns = self._robot.device_ns
            if self._freeze_after_s is not None:
                self._robot.freeze(self._freeze_after_s)
        if self._begun_ns is not None and self._cut_after_s is not None:
            if self._robot.device_ns - self._begun_ns >= round(self._cut_after_s * 1e9):
                self._cut_after_s = None
                self.cut()
        return going_on


def emulation(
    section: Ros2Section, device: Ros2Device, wire: str, port: str, **faults: float | None
) -> Ros2Emulation:
    """Return an emulated robot behind a transport.

    Args:
        section: The topics.
        device: The device.
        wire: "dds" or "zenoh".
        port: A network interface, or an end point to listen at; "": this machine only.
        **faults: See :class:`Ros2Emulation`.
    """
    link = make_link(section, wire, port or PORTS[wire], MonotonicClock(), emulated=True)
    given = {name: value for name, value in faults.items() if value is not None}
    return Ros2Emulation(device, link, section, **given)
