"""Messages between robot, policy, recorder and calibration.

All quantities are SI: m, rad, s, N, N·m. Stamps are monotonic nanoseconds of the named clock. Arrays follow
the joint order of the robot's :class:`~deal_hw.description.RobotDescription`: J joints, of which A are
actuated.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NOT_FOLLOWING: Final = "not following"
"""Kind of the :class:`Event` that joints do not follow their commands, until the recording's end. Its data:
``since_ns``, the host clock from which on they do not [ns], and ``joints``, their names."""


class Status(enum.IntFlag):
    """Status of a robot; each driver maps its own bits onto these."""

    NONE = 0
    ARMED = 1
    """The motors follow commands."""
    HOMED = 2
    """The position reference is valid."""
    HOMING = 4
    WATCHDOG = 8
    """The device stopped its motors because no commands arrived; latched until it is armed again."""
    EFFORT_CLAMPED = 16
    """The device's own effort limit is active."""
    SPEED_CLAMPED = 32
    """The device's own speed limit is active."""
    AT_END_STOP = 64
    FAULT = 128


@dataclass(frozen=True, slots=True)
class BodyState:
    """Sensed state of a legged robot besides its joints' motion, at the same time.

    Attributes:
        orientation: Unit quaternion wxyz, base in the world, (4,).
        angular_velocity: In the base's frame, (3,) [rad/s].
        acceleration: Specific force in the base's frame, (3,) [m/s²]: +9.81 upwards at rest.
        foot_force: The feet's sensors in the robot's own units and the description's order of legs, (F,).
        temperature: Of each motor, (J,) [°C].
        lost: Commands that each motor missed so far, as the robot counts them, (J,).
        battery: State of charge, 0 to 1; NaN where unknown.
        voltage: Of the supply [V].
        current: Drawn from the supply [A].
        sticks: The operator's remote: left x, left y, right x, right y, each -1 to 1, (4,).
        buttons: The remote's buttons, a bit each, as the driver names them; -1: no remote is heard.
    """

    orientation: FloatArray
    angular_velocity: FloatArray
    acceleration: FloatArray
    foot_force: FloatArray
    temperature: FloatArray
    lost: IntArray
    battery: float
    voltage: float
    current: float
    sticks: FloatArray
    buttons: int


@dataclass(frozen=True, slots=True)
class RobotState:
    """One sample of a robot's state.

    Attributes:
        position: Joint positions, (J,) [m or rad].
        velocity: Joint velocities, (J,) [m/s or rad/s].
        effort: The device's own estimate of joint efforts, (J,) [N or N·m].
        receive_ns: Host clock at reception [ns].
        device_ns: Device clock at which the sample was sent [ns].
        sequence: Number of the sample, counted by the device.
        command_sequence: Number of the active command; -1 before the first.
        command_age_ns: Device time since that command was received [ns]; -1 before the first.
        status: Status bits of the robot.
        body: Further sensed state of a legged robot; None for other robots.
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    receive_ns: int
    device_ns: int
    sequence: int
    command_sequence: int
    command_age_ns: int
    status: Status
    body: BodyState | None = None


@dataclass(frozen=True, slots=True)
class JointCommand:
    """PD targets for the actuated joints, each array (A,).

    Attributes:
        position_target: [m or rad].
        velocity_target: [m/s or rad/s].
        stiffness: kp [N/m or N·m/rad].
        damping: kd [N·s/m or N·m·s/rad].
        effort: Feed-forward effort [N or N·m].
        effort_limit: The effort the device may use [N or N·m].
        speed_limit: How fast the device may move its set-point [m/s or rad/s].
    """

    position_target: FloatArray
    velocity_target: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    effort: FloatArray
    effort_limit: FloatArray
    speed_limit: FloatArray


@dataclass(frozen=True, slots=True)
class Event:
    """An event at one time.

    Attributes:
        stamp_ns: Host clock [ns].
        kind: A short name such as ``"armed"``, ``"clipped"``, ``"passive"``, ``"overrun"``.
        message: One sentence for the operator.
        data: Plain JSON values.
    """

    stamp_ns: int
    kind: str
    message: str
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class BodyTrajectory:
    """:class:`BodyState` at the T samples of a recording; rows of samples without one are NaN.

    Attributes:
        orientation: (T, 4).
        angular_velocity: (T, 3) [rad/s].
        acceleration: (T, 3) [m/s²].
        foot_force: (T, F).
        temperature: (T, J) [°C].
        lost: (T, J).
        battery: (T,), 0 to 1.
        voltage: (T,) [V].
        current: (T,) [A].
        sticks: (T, 4).
        buttons: (T,), -1 where no remote was heard.
    """

    orientation: FloatArray
    angular_velocity: FloatArray
    acceleration: FloatArray
    foot_force: FloatArray
    temperature: FloatArray
    lost: FloatArray
    battery: FloatArray
    voltage: FloatArray
    current: FloatArray
    sticks: FloatArray
    buttons: IntArray


@dataclass(frozen=True, slots=True)
class BaseTrajectory:
    """Where a floating base is at the T samples of a recording, as motion capture or odometry report it.

    Attributes:
        position: Origin of the base's frame in the world, (T, 3) [m].
        velocity: Its velocity in the world, (T, 3) [m/s]; NaN where nothing reports it.
    """

    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class Trajectory:
    """One recording: T state samples and C commands.

    Attributes:
        joint_names: The J joints.
        actuated: The A actuated joints.
        receive_s: Host time of each sample since the first, (T,) [s].
        device_s: Device time of each sample since the first, (T,) [s]; the time base of calibration.
        position: (T, J).
        velocity: (T, J).
        effort: (T, J).
        status: (T,), :class:`Status` bits.
        command_sequence: The active command at each sample, (T,); -1 for none.
        command_age_s: Device time since that command was received, (T,) [s]; NaN for none.
        sent_s: Host time of each command, on the time base of ``receive_s``, (C,) [s].
        sent_sequence: Number of each command, (C,).
        requested_position: Position targets that the policy requested, (C, A).
        position_target: Position targets actually sent, (C, A).
        stiffness: (C, A).
        damping: (C, A).
        effort_limit: (C, A).
        speed_limit: (C, A).
        events: Events.
        metadata: Plain JSON values: robot, description digest, purpose, policy, task, ...
        body: Further sensed state of a legged robot; None for other robots.
        base: Place of a floating base; None where nothing reports it. Datasets do not hold it.
    """

    joint_names: tuple[str, ...]
    actuated: tuple[str, ...]
    receive_s: FloatArray
    device_s: FloatArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    status: IntArray
    command_sequence: IntArray
    command_age_s: FloatArray
    sent_s: FloatArray
    sent_sequence: IntArray
    requested_position: FloatArray
    position_target: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    effort_limit: FloatArray
    speed_limit: FloatArray
    events: Sequence[Event] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)
    body: BodyTrajectory | None = None
    base: BaseTrajectory | None = None

    @property
    def duration_s(self) -> float:
        """Device time between the first and the last sample [s]."""
        return float(self.device_s[-1] - self.device_s[0]) if self.device_s.size else 0.0
