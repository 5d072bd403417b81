"""Contract of a robot description: facts about one robot, each with its source."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

EFFORT_UNITS: Final[Mapping[str, str]] = {"m": "N", "rad": "N·m"}
"""Unit of a joint's effort by that of its position."""

ACTUATIONS: Final = ("position", "motor")
"""Kinds of actuator commands: set-points of a PD position loop, or efforts as a share of the limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """Sensor effects between the true state and the reported one.

    Attributes:
        noise: Standard deviation of white noise on positions, (J,) [m or rad].
        resolution: Quantisation step of positions, (J,) [m or rad]; 0 for none.
        velocity_window_s: Velocities are position differences over this time [s]; 0: the true velocity.
    """

    noise: tuple[float, ...]
    resolution: tuple[float, ...]
    velocity_window_s: float

    @property
    def position_std(self) -> FloatArray:
        """Standard deviation of a reported position, quantisation included, (J,)."""
        return np.sqrt(np.square(self.noise) + np.square(self.resolution) / 12.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LegLimits:
    """Limits of the safety module for a robot with legs, beyond :class:`SafetyLimits`.

    Attributes:
        effort: Largest predicted PD effort of a command, (A,) [N·m]; to keep it, targets are moved and, last,
            gains lowered.
        tilt: A larger angle between the base's z axis and the vertical trips [rad]; infinite for a robot
            whose base is held.
        tumble: A faster turn about any axis of the base trips [rad/s].
        free_fall: A specific force below this [m/s²] for ``free_fall_s`` is a fall.
        free_fall_s: See ``free_fall`` [s].
        flail_velocity: A joint that stays faster than this for ``flail_s`` trips, (J,) [rad/s].
        flail_s: See ``flail_velocity`` [s].
        temperature: A hotter motor trips [°C].
        lost_rate: A motor that misses more commands per second trips [1/s].
        battery: A lower state of charge refuses to arm [0..1].
        battery_low: A lower one trips [0..1].
        voltage: A lower supply voltage trips [V].
        arm_voltage: A lower one refuses to arm [V]; 0: the same as ``voltage``.
        command_age_s: Longest time without a command sent to the robot [s].
    """

    effort: tuple[float, ...]
    tilt: float
    tumble: float
    free_fall: float
    free_fall_s: float
    flail_velocity: tuple[float, ...]
    flail_s: float
    temperature: float
    lost_rate: float
    battery: float
    battery_low: float
    voltage: float
    command_age_s: float
    arm_voltage: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyLimits:
    """Limits of the safety filter; arrays are tuples in the order of the actuated joints (A) unless noted.

    Attributes:
        target: Lowest and highest position target, (A, 2).
        target_step: Largest change of the target from one command to the next, (A,).
        target_distance: Largest distance of the target from the measured position, (A,).
        trip_position: Leaving this range of measured positions trips, (J, 2); infinite where free.
        trip_velocity: Exceeding this measured speed trips, (J,).
        stiffness: Highest stiffness that may be sent, (A,).
        damping: Highest damping that may be sent, (A,).
        effort: Highest effort limit that may be sent, (A,).
        speed: Highest speed limit that may be sent, (A,).
        state_age_s: An older state trips [s].
        action_age_s: A later action of the policy trips [s].
        ease_in_s: Time over which the policy gets full control [s].
        silence_s: The supervisor kills a control process without a heartbeat for this long [s].
        legs: For a robot with legs; None for others.
        climbing: In place of ``legs`` while a policy that observes a platform drives; None: the same.
        may_be_blocked: Actuated joints that may push at their limit without moving, such as a gripper that
            holds an object.
    """

    target: tuple[tuple[float, float], ...]
    target_step: tuple[float, ...]
    target_distance: tuple[float, ...]
    trip_position: tuple[tuple[float, float], ...]
    trip_velocity: tuple[float, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    effort: tuple[float, ...]
    speed: tuple[float, ...]
    state_age_s: float
    action_age_s: float
    ease_in_s: float
    silence_s: float = 0.3
    legs: LegLimits | None = None
    climbing: LegLimits | None = None
    may_be_blocked: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDescription:
    """Facts about one robot.

    Attributes:
        name: The robot's name, as on the command line.
        joint_names: The J joints, in the order of every array.
        actuated: The A joints that take commands, in command order.
        position_units: Unit of each joint's position, "m" or "rad", (J,).
        default_position: The pose that policies are relative to, (J,).
        stiffness: Default kp, (A,).
        damping: Default kd, (A,).
        effort_limit: Default effort limit, (A,).
        speed_limit: Default speed limit of the set-point, (A,); infinite without a set-point generator.
        control_rate_hz: Rate of commands.
        device_rate_hz: Rate of the PD loop inside the device.
        state_rate_hz: Rate of state samples.
        repeat_rate_hz: Rate at which the driver repeats the current command; 0: each is sent once.
        limits: Limits of the safety filter.
        sensor: The nominal sensor model.
        mjcf: The robot's MuJoCo model.
        actuation: "position": commands are set-points of a PD loop; "motor": commands are efforts, -1..1 of
            ``effort_limit``, and stiffness and damping are 0.
        motors: Actuated joints of a robot of "position" that take efforts all the same, as in ``"motor"``.
        floating_base: Name of the free joint that carries the robot; None for a fixed base. It is not among
            ``joint_names``.
        passive_damping: kd of the passive command, (A,) [N·m·s/rad], for robots whose passive state is
            damping; empty: the motors are off.
        rest_position: The pose in which a robot with legs lies and may go limp, (J,); empty: none.
        feet: Names of the model's foot geoms (spheres), in the order of ``BodyState.foot_force``; empty: no
            legs.
        excitation_range: Range of the actuated joints' targets in excitations, (A, 2), for robots whose parts
            hit each other (or slip) inside the limits; empty: the limits.
        sources: Source of each number, by attribute name.
    """

    name: str
    joint_names: tuple[str, ...]
    actuated: tuple[str, ...]
    position_units: tuple[str, ...]
    default_position: tuple[float, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    effort_limit: tuple[float, ...]
    speed_limit: tuple[float, ...]
    control_rate_hz: float
    device_rate_hz: float
    state_rate_hz: float
    limits: SafetyLimits
    sensor: SensorModel
    mjcf: Path
    actuation: str = "position"
    floating_base: str | None = None
    repeat_rate_hz: float = 0.0
    passive_damping: tuple[float, ...] = ()
    rest_position: tuple[float, ...] = ()
    feet: tuple[str, ...] = ()
    excitation_range: tuple[tuple[float, float], ...] = ()
    motors: tuple[str, ...] = ()
    sources: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = [name for name in self.actuated if name not in self.joint_names]
        if unknown:
            raise ConfigurationError(
                f"robot {self.name!r}: actuated joints {unknown} are not among {self.joint_names}"
            )
        if self.actuation not in ACTUATIONS:
            raise ConfigurationError(
                f"robot {self.name!r}: actuation is {self.actuation!r}; allowed: {', '.join(ACTUATIONS)}"
            )
        unknown = [name for name in self.motors if name not in self.actuated or self.actuation == "motor"]
        if unknown:
            raise ConfigurationError(
                f"robot {self.name!r}: motors names {unknown}; it names actuated joints of a robot whose "
                "other joints are servos"
            )
        if self.floating_base in self.joint_names:
            raise ConfigurationError(
                f"robot {self.name!r}: the free joint {self.floating_base!r} must not be among "
                "joint_names, which have one coordinate each"
            )
        J, A = len(self.joint_names), len(self.actuated)
        for name, length in (
            ("position_units", J),
            ("default_position", J),
            ("stiffness", A),
            ("damping", A),
            ("effort_limit", A),
            ("speed_limit", A),
            ("excitation_range", A if self.excitation_range else 0),
        ):
            if len(getattr(self, name)) != length:
                raise ConfigurationError(
                    f"robot {self.name!r}: {name} has {len(getattr(self, name))} entries, expected {length}"
                )

    def require_actuators(self) -> None:
        """Check that there is something to command.

        Raises:
            ConfigurationError: No joint has an actuator.
        """
        if not self.actuated:
            raise ConfigurationError(
                f"no joint of {self.name!r} has an actuator, so nothing can be commanded: its recordings can "
                "be imported, calibrated and inspected. To move it, give its MJCF actuators"
            )

    @property
    def actuated_index(self) -> tuple[int, ...]:
        """Index of each actuated joint among the joints, (A,)."""
        return tuple(self.joint_names.index(name) for name in self.actuated)

    @property
    def servos(self) -> tuple[bool, ...]:
        """Whether each actuated joint takes positions, (A,); the others take efforts."""
        return tuple(self.actuation == "position" and name not in self.motors for name in self.actuated)

    def held(self, position: FloatArray) -> FloatArray:
        """Return the commands that hold joint positions, (..., J): for motors no effort, (..., A)."""
        return np.where(self.servos, position[..., list(self.actuated_index)], 0.0)

    def in_climb(self) -> RobotDescription:
        """Return the robot with its limits for climbing in force."""
        limits = self.limits
        return dataclasses.replace(
            self, limits=dataclasses.replace(limits, legs=limits.climbing or limits.legs)
        )

    @property
    def steps_per_control(self) -> int:
        """Device periods in one control period."""
        return round(self.device_rate_hz / self.control_rate_hz)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values, with the MJCF's digest instead of its text."""
        values = asdict(self)
        values["mjcf"] = hashlib.sha256(self.mjcf.read_bytes()).hexdigest()
        values["sources"] = dict(self.sources)
        # Default values are omitted, so that a description from before the field existed keeps its digest.
        for facts, known in ((values, fields(self)), (values["limits"], fields(self.limits))):
            for entry in known:
                if facts[entry.name] == entry.default:
                    del facts[entry.name]
        return values

    def digest(self) -> str:
        """Return a digest that changes when any fact changes; sources do not count."""
        return digest_of(self.to_json())


def digest_of(description: Mapping[str, Any]) -> str:
    """Return the digest of a description given as JSON; equals :meth:`RobotDescription.digest`."""
    facts = {key: value for key, value in description.items() if key != "sources"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]
