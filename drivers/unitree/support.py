"""Decides what supports a quadruped: the floor, or a stand that holds its body in the air.

deal-hw has a robot for each, such as ``go2`` and ``go2_on_stand``, and commands for one are dangerous to the
other. No sensor measures the support. Two quantities decide: the distance of the feet below the base, along
gravity, and the force that the legs carry, from the motors' estimated efforts.

- Legs that carry half of the weight stand on the floor.
- A robot with folded legs lies. Legs that were folded when the robot was lifted look the same.
- A robot whose feet reach below the belly and carry nothing is held by something else.

Anything between is undecided. The foot force sensors can only contradict "held by something else". On robots
of this family they drift, and some report 0 (unitree_legged_sdk, issues 34, 50 and 86).
"""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Final, Protocol

import numpy as np

from deal_hw.clock import Clock
from deal_hw.control.safety.leg_checks import UNIT_TOLERANCE, tilt
from deal_hw.drivers.unitree.leg_geometry import LegGeometry
from deal_hw.errors import ConfigurationError, SafetyError, TransportTimeoutError
from deal_hw.types import FloatArray, IntArray

GRAVITY_M_S2: Final = 9.81
PATIENCE_S: Final = 3.0
"""Longest wait until the robot is still [s]."""


class SupportState(Protocol):
    """What is read in a state; arrays in model order (legs FL, FR, RL, RR)."""

    @property
    def position(self) -> FloatArray:
        """Positions, (12,) [rad]."""
        ...

    @property
    def velocity(self) -> FloatArray:
        """Speeds, (12,) [rad/s]."""
        ...

    @property
    def effort(self) -> FloatArray:
        """The motors' estimated efforts, (12,) [N·m]."""
        ...

    @property
    def orientation(self) -> FloatArray:
        """Quaternion wxyz, base in the world, (4,)."""
        ...

    @property
    def angular_velocity(self) -> FloatArray:
        """Base's frame, (3,) [rad/s]."""
        ...

    @property
    def specific_force(self) -> FloatArray:
        """Base's frame, (3,) [m/s²]."""
        ...

    @property
    def foot_force(self) -> IntArray:
        """Sensor units, (4,)."""
        ...


class Support(enum.Enum):
    """The robot's support."""

    FLOOR = "floor"
    """It stands or lies on the floor."""
    HELD = "held"
    """Something holds its body; its feet are free."""
    UNDECIDED = "undecided"
    """The states do not decide."""


WINDOW_S: Final = 0.3
"""The median of the states in this time is used [s]."""
LEAST_STATES: Final = 50
"""Least number of states in that time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SupportConfig:
    """Limits between floor and stand. They come from the emulator; no real robot was measured."""

    legs: LegGeometry
    """Lengths of the legs, and the robot's weight."""

    level_rad: float
    """Largest tilt of a body that lies level or hangs level [rad]."""

    joint_rad_s: float = 0.5
    """A joint above this speed counts as moving; noise of a real robot at rest is a tenth of it [rad/s]."""

    body_rad_s: float = 0.5
    """A body that turns faster counts as swinging; its forces are not used [rad/s]."""

    force_m_s2: float = 1.0
    """Largest difference of specific force and gravity [m/s²]."""

    sensors_rad: float = 0.2
    """Largest angle between the directions of gravity by orientation and by specific force [rad]."""

    held_reach_m: float
    """Three feet of a hanging robot reach further below the base than this [m]."""

    lying_reach_m: float
    """The feet of a lying robot reach no further on average [m]."""

    unloaded: float = 0.25
    """Legs that carry less than this share of the weight count as unloaded; 1 N·m of friction in each knee
    looks like a share of 0.2."""

    loaded: float = 0.5
    """Legs that carry more than this share of the weight count as standing."""

    foot_pressed: float = 60.0
    """A foot sensor above this is pressed, whatever its offset: free ones may show 30 [sensor units]."""

    def __post_init__(self) -> None:
        for name in (entry.name for entry in fields(self) if entry.name != "legs"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"{name} must be positive, got {getattr(self, name)}")
        if not (self.unloaded < self.loaded and self.lying_reach_m < self.held_reach_m):
            raise ConfigurationError("unloaded is less than loaded, and lying_reach_m than held_reach_m")


@dataclass(frozen=True, slots=True)
class SupportReading:
    """The support by some states.

    Attributes:
        support: What supports the robot.
        seen: The observation, as text.
        remedy: What to do if the states do not decide; "" if they do.
    """

    support: Support
    seen: str
    remedy: str = ""


def read_support(states: Sequence[SupportState], config: SupportConfig) -> SupportReading:
    """Return what supports the robot, by the states of a short time.

    Args:
        states: In order of time.
        config: The limits between floor and stand.
    """
    if len(states) < LEAST_STATES:
        return _undecided(f"only {len(states)} states came within {WINDOW_S:g} s", "check the cable")
    position = np.median([state.position for state in states], axis=0)
    effort = np.median([state.effort for state in states], axis=0)
    orientation = np.median([state.orientation for state in states], axis=0)
    force = np.median([state.specific_force for state in states], axis=0)
    joint_speed = float(np.max(np.abs(np.median([state.velocity for state in states], axis=0))))
    body_speed = float(np.linalg.norm(np.median([state.angular_velocity for state in states], axis=0)))
    values = np.concatenate((position, effort, orientation, force, (joint_speed, body_speed)))
    if not np.isfinite(values).all() or abs(float(orientation @ orientation) - 1.0) > UNIT_TOLERANCE:
        return _undecided("a joint, an effort or the inertial sensor gives no number", "restart the robot")
    doubt = _unsteady(orientation, force, joint_speed, body_speed, config)
    if doubt is not None:
        return doubt
    up = _up(orientation)
    reach = -config.legs.foot_positions(position) @ up
    load = float((config.legs.foot_loads(position, effort) @ up).sum())
    feet = np.median([state.foot_force for state in states], axis=0)
    return _judge(reach, load, feet, config)


def _judge(reach: FloatArray, load: float, feet: FloatArray, config: SupportConfig) -> SupportReading:
    """Decide by the feet's distances below the base (4,) [m], a load [N] and foot sensors (4,)."""
    # The second smallest, not the smallest: one leg may be folded.
    third, mean, weight_n = float(np.sort(reach)[1]), float(reach.mean()), config.legs.weight_n
    carried = f"its legs carry {load:.0f} N of its {weight_n:.0f} N"
    if load > config.loaded * weight_n:
        return SupportReading(Support.FLOOR, carried)
    if mean < config.lying_reach_m:
        return SupportReading(
            Support.FLOOR, f"its legs are folded: its feet reach {mean:.2f} m below its body"
        )
    seen = f"its feet reach {mean:.2f} m below its body, and {carried}"
    if abs(load) > config.unloaded * weight_n:
        return _undecided(
            seen, "raise the stand until the feet are free, or lower the robot until it lies on the floor"
        )
    if third < config.held_reach_m:
        return _undecided(
            seen, "on the floor: fold its legs until it lies on its belly; on a stand: pull its legs down"
        )
    if (pressed := int(np.sum(feet > config.foot_pressed))) >= 2:
        return _undecided(
            f"{seen}, but the sensors of {pressed} feet are pressed",
            "raise the stand until the feet are free",
        )
    return SupportReading(Support.HELD, seen)


def _unsteady(
    orientation: FloatArray, force: FloatArray, joint_speed: float, body_speed: float, config: SupportConfig
) -> SupportReading | None:
    """Return why forces and geometry cannot be used; None if the robot is level and still."""
    size = float(np.linalg.norm(force))
    if (
        joint_speed > config.joint_rad_s
        or body_speed > config.body_rad_s
        or (abs(size - GRAVITY_M_S2) > config.force_m_s2)
    ):
        return _undecided(
            f"it moves: a joint at {joint_speed:.1f} rad/s, the body at {body_speed:.1f} rad/s, "
            f"specific force {size:.1f} m/s²",
            "wait until it is still",
        )
    if (lean := tilt(orientation)) > config.level_rad:
        return _undecided(
            f"it leans by {lean:.2f} rad, more than {config.level_rad:g} rad",
            "lay it down level, or level the stand",
        )
    if (apart := float(np.arccos(np.clip(_up(orientation) @ force / size, -1.0, 1.0)))) > config.sensors_rad:
        return _undecided(
            f"the directions of gravity by orientation and by specific force differ by {apart:.2f} rad",
            "restart the robot level and at rest, or calibrate its inertial sensor in the vendor's app",
        )
    return None


def _undecided(seen: str, remedy: str) -> SupportReading:
    return SupportReading(Support.UNDECIDED, seen, remedy)


def _up(orientation: FloatArray) -> FloatArray:
    """Return the vertical in the base's frame, (3,)."""
    w, x, y, z = orientation
    return np.array((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)))


class SupportGuard:
    """Refuses a robot whose support is not that of its description.

    Args:
        name: The robot's name in deal-hw.
        expected: FLOOR or HELD.
        other: Name of the robot with the other support.
        clock: For waiting.
        pump: Receives one message, waiting at most this long [s]; TransportTimeoutError if none arrives.
        config: The limits between floor and stand; None: nothing is checked.
    """

    def __init__(
        self,
        name: str,
        expected: Support,
        other: str,
        clock: Clock,
        pump: Callable[[float], None],
        config: SupportConfig | None,
    ) -> None:
        self._name, self._expected, self._other = name, expected, other
        self._clock, self._pump = clock, pump
        self._config = config
        self._states: list[SupportState] | None = None

    def take(self, state: SupportState) -> None:
        """Take a new state; it is used only during a check."""
        if self._states is not None:
            self._states.append(state)

    def before_release(self) -> None:
        """Refuse a robot that must not be released from its own controller.

        On a stand this needs certainty, because a robot that stands on the floor would fall. A robot for the
        floor is laid down first, so it is refused only if it certainly hangs.

        Raises:
            SafetyError: The robot has another support, or, for a stand, its support is uncertain.
        """
        if self._expected is Support.HELD:
            self.require()
        elif self._config is not None and (found := self._read(self._config)).support is Support.HELD:
            raise SafetyError(self._refusal(found))

    def require(self) -> None:
        """Return once the robot is still and has the expected support.

        Raises:
            SafetyError: It has another support, or its support was uncertain for 3 s.
        """
        if self._config is None:
            return
        deadline_ns = self._clock.now_ns() + round(PATIENCE_S * 1e9)
        while (found := self._read(self._config)).support is not self._expected:
            if found.support is not Support.UNDECIDED or self._clock.now_ns() >= deadline_ns:
                raise SafetyError(self._refusal(found))

    def _read(self, config: SupportConfig) -> SupportReading:
        """Receive new states for the window's length, and decide."""
        states: list[SupportState] = []
        until_ns = self._clock.now_ns() + round(WINDOW_S * 1e9)
        self._states = states
        try:
            while (left_ns := until_ns - self._clock.now_ns()) > 0:
                with contextlib.suppress(TransportTimeoutError):
                    self._pump(left_ns * 1e-9)
        finally:
            self._states = None
        return read_support(states, config)

    def _refusal(self, found: SupportReading) -> str:
        floor = self._expected is Support.FLOOR
        skip = "To go without this check: --no-support-check"
        if found.support is Support.UNDECIDED:
            where = "lies on the floor" if floor else "is held in the air"
            return (
                f"{self._name}: it is uncertain whether the robot {where}: {found.seen}. No command was "
                f"sent. What to do: {found.remedy}. {skip}"
            )
        if floor:
            return (
                f"{self._name}: something holds the robot in the air: {found.seen}. `{self._name}` is the "
                "robot on the floor: it would stand up and walk in the air. Lay it on the floor, or take the "
                f"robot `{self._other}`. {skip}"
            )
        return (
            f"{self._name}: the robot is on the floor: {found.seen}. `{self._name}` makes a standing robot "
            "limp and moves its legs as in free air: it would fall. Hang it up with its feet free (if it "
            f"hangs already, pull its legs down by hand), or take the robot `{self._other}`. {skip}"
        )
