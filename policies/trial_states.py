"""Test states of a robot for a policy: nominal, extreme and random, within its description."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.motions.velocity import LARGEST
from deal_hw.types import BodyState, FloatArray, RobotState, Status

Kind = Literal["nominal", "extreme", "random"]

_REACH: Final = {"rad": math.pi, "m": 1.0}
"""Largest distance from the default pose of a joint without position limits [rad or m]."""
_SPEED: Final = {"rad": 50.0, "m": 5.0}
"""Speed of a joint without speed limit [rad/s or m/s]."""
_TILT_RAD: Final = math.pi
_TUMBLE_RAD_S: Final = 6.0
_REST: Final = np.zeros(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """One test state.

    Attributes:
        kind: Kind of the state.
        name: Its description, for messages.
        state: The state.
        velocity: The commanded velocity of the base: ahead, left [m/s], turn [rad/s], (3,).
        fresh: Whether the past is cleared first, so that delayed terms show this state, too.
    """

    kind: Kind
    name: str
    state: RobotState
    velocity: FloatArray
    fresh: bool


class GivenVelocity:
    """A commanded velocity that is set from outside, (3,)."""

    def __init__(self) -> None:
        self.wanted: FloatArray = _REST

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the commanded velocity."""
        return self.wanted


class ProbeStates:
    """Makes the test states of one robot, inside its trip limits.

    Limits are those of joint positions and speeds, and of the base's tilt and turn rate, if it has one.
    """

    def __init__(self, description: RobotDescription) -> None:
        limits, units = description.limits, description.position_units
        self._names = description.joint_names
        self._default = np.array(description.default_position)
        reach = np.array([_REACH[unit] for unit in units])
        low, high = np.array(limits.trip_position, dtype=float).T
        self._low = np.where(np.isfinite(low), low, self._default - reach)
        self._high = np.where(np.isfinite(high), high, self._default + reach)
        speed = np.array(limits.trip_velocity, dtype=float)
        self._speed = np.where(np.isfinite(speed), speed, [_SPEED[unit] for unit in units])
        self._feet = len(description.feet)
        self._has_base = limits.legs is not None or description.floating_base is not None
        self._tilt, self._tumble = _TILT_RAD, _TUMBLE_RAD_S
        if limits.legs is not None:
            self._tilt = min(limits.legs.tilt, _TILT_RAD)
            self._tumble = limits.legs.tumble

    def nominal(self, count: int) -> Iterator[Probe]:
        """Yield the default pose at rest, several times, because the time of an action varies."""
        for _ in range(count):
            yield self._probe("nominal", "default pose")

    def extreme(self) -> Iterator[Probe]:
        """Yield joints at their ends, one and all, at top speed, and the extremes of base and command."""
        ends = (("lowest", self._low), ("highest", self._high))
        for end, values in ends:
            for i, name in enumerate(self._names):
                position = self._default.copy()
                position[i] = values[i]
                yield self._probe("extreme", f"{end} position of {name!r}", position=position)
            yield self._probe("extreme", f"{end} positions", position=values)
        for sign, word in ((-1.0, "backward"), (1.0, "forward")):
            yield self._probe("extreme", f"top speed {word}", velocity=sign * self._speed)
            yield self._probe(
                "extreme", f"top speed {word} at the end", position=self._high, velocity=sign * self._speed
            )
            for i, axis in enumerate("xyz"):
                unit = sign * np.eye(3)[i]
                wanted = unit * LARGEST
                yield self._probe("extreme", f"fastest command {wanted.tolist()}", wanted=wanted)
                if self._has_base:
                    yield self._probe("extreme", f"tilt about {axis}", turn=self._tilt * unit)
                    yield self._probe("extreme", f"turning about {axis}", gyro=self._tumble * unit)

    def random(self, count: int, rng: np.random.Generator) -> Iterator[Probe]:
        """Yield random states; each is the past of the next."""
        for i in range(count):
            axis = rng.standard_normal(3)
            yield self._probe(
                "random",
                f"random state {i}",
                position=rng.uniform(self._low, self._high),
                velocity=rng.uniform(-self._speed, self._speed),
                turn=rng.uniform(0.0, self._tilt) * axis / np.linalg.norm(axis),
                gyro=rng.uniform(-self._tumble, self._tumble, 3),
                wanted=rng.uniform(-np.array(LARGEST), LARGEST),
                fresh=i == 0,
            )

    def _probe(
        self,
        kind: Kind,
        name: str,
        *,
        position: FloatArray | None = None,
        velocity: FloatArray | None = None,
        turn: FloatArray = _REST,
        gyro: FloatArray = _REST,
        wanted: FloatArray = _REST,
        fresh: bool = True,
    ) -> Probe:
        J = len(self._default)
        state = RobotState(
            position=self._default if position is None else position,
            velocity=np.zeros(J) if velocity is None else velocity,
            effort=np.zeros(J),
            receive_ns=0,
            device_ns=0,
            sequence=0,
            command_sequence=-1,
            command_age_ns=-1,
            status=Status.ARMED,
            body=self._body(turn, gyro) if self._has_base else None,
        )
        return Probe(kind=kind, name=name, state=state, velocity=wanted, fresh=fresh)

    def _body(self, turn: FloatArray, gyro: FloatArray) -> BodyState:
        angle = float(np.linalg.norm(turn))
        half = math.sin(angle / 2) * turn / angle if angle > 0 else _REST
        J = len(self._default)
        return BodyState(
            orientation=np.array([math.cos(angle / 2), *half]),
            angular_velocity=gyro,
            acceleration=np.array([0.0, 0.0, 9.81]),
            foot_force=np.zeros(self._feet),
            temperature=np.full(J, 30.0),
            lost=np.zeros(J, dtype=np.int64),
            battery=1.0,
            voltage=30.0,
            current=0.0,
            sticks=np.zeros(4),
            buttons=-1,
        )
