"""An emulated robot of ros2_control: joint_state_broadcaster, controller, and the joints that it moves."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.ros2.command_log import HOLDS, MOVES, Event, Ros2CommandLog
from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.ros2.messages import (
    ACTIVE,
    INACTIVE,
    JointStates,
    TrajectoryPoint,
    decode_point,
    decode_positions,
    encode_activity,
    encode_joint_states,
    encode_point,
    encode_positions,
)
from deal_hw.drivers.ros2.topics import topics_of
from deal_hw.errors import FrameError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.closed_loop import reported
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.robots.ros2_section import Ros2Section
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.testing.faults import FaultRates, FrameFaults
from deal_hw.testing.joint_faults import FaultyJoints, JointFaults
from deal_hw.types import FloatArray

EPOCH_NS: Final = 1_700_000_000_000_000_000
"""Stamp of device time 0 [ns]: ROS counts from 1970, and no clock here does."""


@dataclass(frozen=True, slots=True, eq=False)
class _Move:
    """Where the controller brings the set-point, from when to when [ticks]."""

    begin: FloatArray
    end: FloatArray
    from_tick: int
    to_tick: int


class Ros2Device:
    """A robot of ros2_control in device time.

    Each tick is a physics step. The controller_manager updates at the robot's state rate: it publishes the
    joint states, all joints in alphabetic order, and its controller takes the newest command. A command acts
    after the truth's latency. A forward controller applies it at once and for ever; a joint trajectory
    controller goes to the point on a straight line in the point's time, and stays there.

    Attributes:
        active: Whether the controller is active; an inactive one receives commands and ignores them.
        joint_faults: Faults of the joints; may be given at any time.
        host_origin_ns: Host clock at device time 0, for the log [ns].
        changes: What happened: device time [ms], host time [ns] and the event; those of commands are of
            :mod:`deal_hw.drivers.ros2.command_log`.
        accepted: Commands that the controller took.
        refused: Commands that it could not use.

    Args:
        section: The controller and the topics.
        robot: The model.
        space: The parameters of the truth.
        truth: Hidden values.
        noisy: Whether positions have the noise of the robot's description.
        rates: Faults of the joint states on the wire.
        joint_faults: Faults of the joints.
        faults: Faults of the controller.
    """

    def __init__(
        self,
        section: Ros2Section,
        robot: RobotModel,
        space: ParameterSpace,
        truth: SimulatedTruth,
        *,
        noisy: bool = True,
        rates: FaultRates | None = None,
        joint_faults: JointFaults | None = None,
        faults: ControllerFaults | None = None,
    ) -> None:
        self._controller_faults = faults or ControllerFaults()
        self._told_active: bool | None = None
        self._first_ns: int | None = None
        d: RobotDescription = robot.description
        self.active, self.host_origin_ns = True, 0
        self.changes: list[tuple[int, int, str]] = []
        self.accepted = self.refused = self.sent = 0
        self._last_refusal = ""
        self._log = Ros2CommandLog()
        self._description, self._section, self._truth = d, section, truth
        self._topics = topics_of(section)
        self._actuated = np.array(d.actuated_index)
        joints = section.joints or d.actuated
        self._command_names = [section.ros_name(joint) for joint in joints]
        self._place = np.array([d.actuated.index(joint) for joint in joints])
        ros = [section.ros_name(joint) for joint in d.joint_names]
        self._order = sorted(range(len(ros)), key=ros.__getitem__)
        self._names = tuple(ros[j] for j in self._order)
        self._noise = d.sensor.noise if noisy else (0.0,) * len(ros)
        self._step_of_sensor = d.sensor.resolution
        self._batch = ServoBatch(robot, space, 1, threads=1)
        self._batch.set_parameters(np.array([[truth.parameters[name] for name in space.names]]))
        self.joint_faults = FaultyJoints(joint_faults or JointFaults(), d.joint_names, d.actuated_index)
        self._drive(limp=False)
        self._effort = self._batch.batch.bind("qfrc_actuator")
        self._dofs = list(robot.qvel)
        self._rng = np.random.default_rng((truth.seed, 3))
        self._faults = FrameFaults(rates or FaultRates(), np.random.default_rng((truth.seed, 4)), None)
        self._tick_ns = round(1e9 / d.device_rate_hz)
        self._stride = max(round(d.device_rate_hz / d.state_rate_hz), 1)
        self._latency_ns = round(1e9 * truth.latency_s)
        self._tick = self._cut_end = 0
        self._clock_ns = EPOCH_NS
        self._frozen = False
        self._freeze_tick: int | None = None
        self._coming: deque[tuple[int, FloatArray, int]] = deque()
        self.place(np.array(d.default_position))

    def place(self, position: FloatArray) -> None:
        """Put the joints somewhere at rest, (J,) [rad or m], and let the drives hold them there."""
        self._batch.set_state(position[None], np.zeros((1, len(position))))
        at = position[self._actuated]
        self._move = _Move(at, at, 0, 0)

    @property
    def true_position(self) -> FloatArray:
        """True positions of the joints, (J,) [rad or m]; never on the wire."""
        return np.array(self._batch.position[0])

    @property
    def device_ns(self) -> int:
        """Device time of the next tick [ns]."""
        return self._tick * self._tick_ns

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Take a message from the host."""
        if topic != self._topics.commands or self._is_cut:
            return
        try:
            target, after_s = self._decode(payload)
        except FrameError as error:
            self.refused += 1
            self._last_refusal = str(error)
            return
        host_ns = stamp_ns or self.host_origin_ns + self.device_ns
        at = self._batch.position[0][self._actuated]
        for event in self._log.take(self.device_ns, host_ns, target, at):
            self._enter(event)
        if not self.active:
            return
        self.accepted += 1
        if self.accepted == 1:
            self._first_ns = self.device_ns
            self.joint_faults.begin(self.device_ns)
        due = math.ceil((self.device_ns + self._latency_ns) / self._tick_ns - 1e-6)
        # The controller reads commands at the manager's updates.
        due = -(-due // self._stride) * self._stride
        self._coming.append((due, target, max(round(after_s * 1e9 / self._tick_ns), 0)))

    def advance_to(self, device_ns: int) -> list[tuple[str, bytes]]:
        """Run every tick up to and including a time [ns]; return the messages sent meanwhile."""
        out: list[tuple[str, bytes]] = []
        while self.device_ns <= device_ns:
            out += self.tick()
        return out

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one tick; return the messages sent in it."""
        out: list[tuple[str, bytes]] = []
        self._switch()
        if not self._frozen and self._tick % self._stride == 0:
            while self._coming and self._coming[0][0] <= self._tick:
                _, target, ticks = self._coming.popleft()
                self._move = _Move(self.setpoint, target, self._tick, self._tick + ticks)
            out = [*self._activity(), *self._states()]
        if (event := self.joint_faults.advance(self.device_ns)) is not None:
            self._note(event or "sound")
        if self.joint_faults.limp != self._limp:
            self._drive(limp=self.joint_faults.limp)
        held = self._batch.position.copy() if self.joint_faults.held else None
        self._batch.advance(self.setpoint[None, None])
        if held is not None:
            self._batch.set_state(held, np.zeros_like(held))
        self._log.move(self.device_ns, self._batch.velocity[0][self._actuated])
        self._tick += 1
        if not self._frozen and self._freeze_tick is not None and self._tick >= self._freeze_tick:
            self._frozen = True
            self._note("frozen")
        return [] if self._is_cut else out

    def _switch(self) -> None:
        """Deactivate the controller, and activate it again, at the times of its faults."""
        faults, first_ns = self._controller_faults, self._first_ns
        if faults.controller_off_after_s is None or first_ns is None:
            return
        passed_s = (self.device_ns - first_ns) * 1e-9 - faults.controller_off_after_s
        active = not 0.0 <= passed_s < faults.controller_off_s
        if active != self.active:
            self.switch(active=active)

    def _activity(self) -> list[tuple[str, bytes]]:
        """Return the controller_manager's message where a controller's state changed."""
        if self._controller_faults.silent_manager or self.active == self._told_active:
            return []
        self._told_active = self.active
        name = self._section.controller.strip("/").rpartition("/")[2]
        states = {"joint_state_broadcaster": ACTIVE, name: ACTIVE if self.active else INACTIVE}
        return [(self._topics.activity, encode_activity(self._clock_ns + self.device_ns, states))]

    def switch(self, *, active: bool) -> None:
        """Activate the controller, or deactivate it: then the drives hold their set-points."""
        self.active = active
        self._note("controller active" if active else "controller off")
        if active and self._section.command == "trajectory":
            # A joint trajectory controller holds the pose in which it is activated.
            at = self._batch.position[0][self._actuated].copy()
            self._move = _Move(at, at, 0, 0)

    def jump_clock(self, seconds: float) -> None:
        """Let the stamps jump ahead, or back if negative [s]."""
        self._clock_ns += round(seconds * 1e9)

    def command_aside(self, by: float) -> tuple[str, bytes]:
        """Return topic and message by which another program wants the joints aside of where they are.

        Args:
            by: How far [rad or m].
        """
        target = (self._batch.position[0][self._actuated] + by)[self._place]
        if self._section.command == "trajectory":
            return self._topics.commands, encode_point(
                TrajectoryPoint(tuple(self._command_names), target, 0.1)
            )
        return self._topics.commands, encode_positions(target)

    def cut(self, seconds: float) -> None:
        """Let nothing pass in either direction for a while [s]."""
        self._cut_end = self._tick + round(seconds * 1e9 / self._tick_ns)
        self._note(f"cut for {seconds:g} s")

    def freeze(self, after_s: float) -> None:
        """Stop the controller_manager after a time [s]; the drives hold their set-point."""
        self._freeze_tick = self._tick + round(after_s * 1e9 / self._tick_ns)

    def report(self) -> dict[str, Any]:
        """Return the truth and what happened, as plain JSON values."""
        return {
            **self._truth.to_json(),
            "states_sent": self.sent,
            "commands_accepted": self.accepted,
            "commands_refused": self.refused,
            "last_refusal": self._last_refusal,
            "wire_faults": {
                name: getattr(self._faults, name) for name in ("corrupted", "dropped", "duplicated")
            },
            "changes": [list(change) for change in self.changes],
            **self._log.to_json(),
        }

    @property
    def _is_cut(self) -> bool:
        return self._tick < self._cut_end

    def _drive(self, *, limp: bool) -> None:
        """Give the drives the description's gains, or none."""
        self._limp = limp
        d, share = self._description, 0.0 if limp else 1.0
        self._batch.set_sent(
            share * np.array(d.stiffness), share * np.array(d.damping), np.array(d.effort_limit)
        )

    def _note(self, event: str) -> None:
        self._enter((self.device_ns // 1_000_000, self.host_origin_ns + self.device_ns, event))

    def _enter(self, event: Event) -> None:
        self.changes.append(event)
        if event[2] not in (MOVES, HOLDS):
            self._log.watch(self.device_ns, event[1], event[2])

    def _decode(self, payload: bytes) -> tuple[FloatArray, float]:
        """Return a command's targets in the order of the actuated joints, (A,), and its time [s]."""
        if self._section.command == "trajectory":
            point = decode_point(payload)
            names, position, after_s = list(point.names), point.position, point.after_s
            if sorted(names) != sorted(self._command_names):
                raise FrameError(f"JointTrajectory of {names}, the controller has {self._command_names}")
            position = position[[names.index(name) for name in self._command_names]]
        else:
            position, after_s = decode_positions(payload), 0.0
            if len(position) != len(self._command_names):
                raise FrameError(f"{len(position)} values for {len(self._command_names)} joints")
        if not np.isfinite(position).all():
            raise FrameError(f"values that are not finite: {position}")
        target = np.zeros(len(position))
        target[self._place] = position
        return target, after_s

    @property
    def setpoint(self) -> FloatArray:
        """Set-points of the drives now, (A,) [rad or m]."""
        move = self._move
        if self._tick >= move.to_tick:
            return move.end
        share = (self._tick - move.from_tick) / (move.to_tick - move.from_tick)
        return np.asarray(move.begin + share * (move.end - move.begin))

    def _states(self) -> list[tuple[str, bytes]]:
        position = reported(self._batch.position[0], self._noise, self._step_of_sensor, self._rng)
        position, velocity = self.joint_faults.read(position, self._batch.velocity[0])
        payload = encode_joint_states(
            JointStates(
                stamp_ns=self._clock_ns + self.device_ns,
                names=self._names,
                position=position[self._order],
                velocity=velocity[self._order],
                effort=self._effort[0, self._dofs][self._order],
            )
        )
        arriving = self._faults.apply(payload)
        self.sent += 1
        size = len(payload)
        return [(self._topics.states, arriving[k : k + size]) for k in range(0, len(arriving), size)]
