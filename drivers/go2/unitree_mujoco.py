"""The vendor's simulator unitree_mujoco in the place of a Go2, and the checks for its states.

It uses the Go2's topics, but leaves parts of its states empty (:mod:`fakes.unitree_mujoco` lists them). An
option must name the simulator. A state with a head or a battery is from a real robot, and is
refused.

| missing | what is checked instead |
|---|---|
| head | the states must have none, and no battery: then they are not a real Go2's |
| tick | a state is new where it differs from the one before, and is as old as its reception |
| checksum | length and header; the checksums of UDP or TCP stand for the rest |
| battery | nothing: the limits of charge and voltage are 0 |
| motion switcher | nothing is released; before arming no other program may command the motors |

It computes torques once for each command, and holds them. So the driver sends the passive command again with
each state. The robot counts as passive only once its joints are slow.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.descriptions import on_stand
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.refusals import StateCheck
from deal_hw.drivers.go2.messages.simulated import NOTICE, decode_simulated
from deal_hw.drivers.go2.robot import STOP_BUTTONS, Go2Robot
from deal_hw.drivers.go2.state_stream import StateStream
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.errors import ConfigurationError, FrameError, WrongDeviceError
from deal_hw.transport import Message, TopicTransport


@dataclass(frozen=True, kw_only=True)
class UnitreeMujocoConfig:
    """Limits of the checks."""

    still_rad_s: float = 0.1
    """Joint speed below which the simulator counts as passive [rad/s]: with the passive damping of 5
    N·m·s/rad it holds at most 0.5 N·m afterwards. A limp robot that lies was seen at 0.004 rad/s."""

    def __post_init__(self) -> None:
        if not self.still_rad_s > 0:
            raise ConfigurationError(f"still_rad_s must be positive, got {self.still_rad_s}")


class SimulatorStream(StateStream):
    """Checks states without a tick: a state that differs is new, and its time is that of its reception.

    The simulator publishes faster than its physics steps, so a repeated state is no error. It is skipped, and
    the limit of a state's age holds. Lost states cannot be detected.
    """

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._last = b""

    @property
    def doubled(self) -> bool:
        """False, because states repeat here. DDS's discovery finds a second simulator."""
        return False

    @property
    def standstill(self) -> str:
        """Text on what does not change in states that are not new."""
        return "nothing in them changes"

    def take(self, message: Message) -> LowStateFrame | None:
        """Return the state in a message; None where it is corrupt or not new.

        Raises:
            VersionMismatchError: It has a head, as a real Go2's.
        """
        payload = message.payload
        try:
            frame = decode_simulated(payload)
        except FrameError as error:
            self.errors += 1
            self._refused.add(payload, error)
            return None
        if payload == self._last:
            self.stale += 1
            return None
        self._last = payload
        self.device_ns = max(message.stamp_ns, self.device_ns + 1)
        self.sequence += 1
        self.accepted += 1
        return frame


def without_battery(description: RobotDescription) -> RobotDescription:
    """Return the description of a Go2 without limits of charge and voltage; all others stay."""
    limits = description.limits
    if limits.legs is None:
        raise ConfigurationError(f"{description.name}: no limits of a robot with legs")
    legs = dataclasses.replace(limits.legs, battery=0.0, battery_low=0.0, voltage=0.0, arm_voltage=0.0)
    why = "unitree_mujoco has no battery"
    return dataclasses.replace(
        description,
        limits=dataclasses.replace(limits, legs=legs),
        sources={
            **description.sources,
            **dict.fromkeys(("legs.battery", "legs.battery_low", "legs.voltage", "legs.arm_voltage"), why),
        },
    )


class UnitreeMujocoRobot(Go2Robot):
    """The driver of a Go2, for the simulator unitree_mujoco.

    Args:
        transport: Topics of the simulator.
        clock: The clock of the transport's stamps.
        stop_buttons: As the Go2's; the simulator has them where a gamepad is plugged in.
        support_check: As the Go2's.
        config: Limits of the checks.
    """

    description: ClassVar[RobotDescription] = without_battery(DRIVER)
    notice: ClassVar[str] = NOTICE
    _has_services: ClassVar[bool] = False

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        *,
        stop_buttons: str = STOP_BUTTONS,
        support_check: bool = True,
        config: UnitreeMujocoConfig | None = None,
    ) -> None:
        self._config = config or UnitreeMujocoConfig()
        super().__init__(transport, clock, stop_buttons=stop_buttons, support_check=support_check)

    def _make_stream(self, check: StateCheck) -> StateStream:
        return SimulatorStream(check)

    def _await_robot(self) -> None:
        super()._await_robot()
        writers = self._transport.writers(topics.LOW_STATE)
        if len(writers) > 1:
            raise WrongDeviceError(
                f"go2: {len(writers)} programs write {topics.LOW_STATE}: {'; '.join(writers)}. Without clock "
                "and checksum their states cannot be distinguished; stop all but one, or choose another "
                "domain"
            )

    def _take_frame(self, frame: LowStateFrame, receive_ns: int) -> None:
        super()._take_frame(frame, receive_ns)
        if not self._armed:
            # Its damping is a torque that holds until the next command. Sent every 20 ms it shakes the legs.
            self.repeat()

    def _is_passive(self, frame: LowStateFrame) -> bool:
        return super()._is_passive(frame) and bool(
            np.nanmax(np.abs(frame.velocity)) < self._config.still_rad_s
        )


class UnitreeMujocoOnStandRobot(UnitreeMujocoRobot):
    """A simulated Go2 whose base is held in the air, as by the simulator's elastic band."""

    description: ClassVar[RobotDescription] = without_battery(on_stand.DESCRIPTION)
    other_support: ClassVar[str] = "go2"
