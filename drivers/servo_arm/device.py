"""An emulated arm: servos' bytes in and out, and the joints that they drive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from deal_hw.drivers.servo_arm.emulated_families import EmulatedJoint
from deal_hw.drivers.servo_arm.families import DAMPING, OFF, ON
from deal_hw.drivers.servo_arm.faults import ArmFaults
from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.drivers.servo_bus.other_master import DOUBLED, FOREIGN, WAY_TICKS, OtherMaster
from deal_hw.drivers.servo_bus.servos_side import ServosSide
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.robots.hardware_section import RAD, TICKS, HardwareSection
from deal_hw.sim.robots.simulated import SimulatedTruth
from deal_hw.testing.joint_faults import WHOLE_TURN, FaultyJoints, JointFaults
from deal_hw.types import FloatArray

BRAKE: Final = 0.55
"""Damping of a motor whose terminals are joined [N·m·s/rad]: kt²/R of an STS3215 in BAM's identification."""

_LOOK_TICKS: Final = 5
"""Physics steps between two looks of the servos' protections, which take ten milliseconds and more. A request
that comes between them is answered with what is measured then."""

_BEYOND_RAD: Final = 0.2
"""How far beyond its range a reading stands that is out of range [rad]."""


class ArmDevice:
    """An arm in device time, for a pseudo-terminal or a virtual wire.

    Each tick is one physics step: the servos' registers give set-points, gains and torque, then the joints
    move, then the registers show what the servos measure. Goals act after the truth's latency.

    Attributes:
        joints: The servos, in the order of the joints.
        bus: Their side of the wire.
        received_bytes: Number of bytes from the host.
        joint_faults: Faults of the joints; may be given at any time.

    Args:
        hardware: The servos' zeros, directions and gains.
        robot: The model.
        space: The parameters of the truth.
        truth: Hidden values.
        joints: The emulated servos, in the order of the joints.
        bus: Their bus.
        faults: Faults of one servo.
        noisy: Whether positions have the noise of the robot's description.
        joint_faults: Faults of the joints.

    Raises:
        ConfigurationError: No servo has the id of the faulty one.
    """

    def __init__(
        self,
        hardware: HardwareSection,
        robot: RobotModel,
        space: ParameterSpace,
        truth: SimulatedTruth,
        joints: Sequence[EmulatedJoint],
        bus: ServosSide[Any],
        *,
        faults: ArmFaults | None = None,
        noisy: bool = True,
        joint_faults: JointFaults | None = None,
    ) -> None:
        self.joints, self.bus, self.received_bytes = tuple(joints), bus, 0
        d = robot.description
        by_joint = {servo.joint: servo for servo in hardware.servos}
        self._servos = [by_joint[name] for name in d.joint_names]
        self._description, self._noisy = d, noisy
        self._actuated = np.array(d.actuated_index)
        self._batch = ServoBatch(robot, space, 1, threads=1)
        self._batch.set_parameters(np.array([[truth.parameters[name] for name in space.names]]))
        self._effort = self._batch.batch.bind("qfrc_actuator")
        self._dofs = list(robot.qvel)
        self._of_id = {servo.id: j for j, servo in enumerate(self._servos)}
        self._due = self._schedule(faults or ArmFaults())
        # A servo shows one turn only.
        ends = np.array([high for _, high in d.limits.trip_position])
        beyond = np.where(np.isfinite(ends), ends + _BEYOND_RAD, WHOLE_TURN)
        self.joint_faults = FaultyJoints(
            joint_faults or JointFaults(), d.joint_names, d.actuated_index, beyond
        )
        self._first_ns: int | None = None
        self._other: OtherMaster | None = None
        self._bus_trouble = ""
        limits = dict(zip(d.actuated, d.effort_limit, strict=True))
        # Without a limit nothing says what share of the voltage an effort takes.
        self._most = [
            limits[name] if math.isfinite(limits.get(name, math.inf)) else 0.0 for name in d.joint_names
        ]
        self._rng = np.random.default_rng((truth.seed, 2))
        self._tick_ns = round(1e9 / d.device_rate_hz)
        self._latency_ns = round(1e9 * truth.latency_s)
        self._coming: deque[tuple[int, FloatArray]] = deque()
        self._tick = self._now_ns = 0
        self._stale = True
        self._held: dict[int, float] = {}
        self._hands: dict[int, float] = {}
        self._sent: tuple[float, ...] = ()
        home = np.array(d.default_position)
        self._batch.set_state(home[None], np.zeros((1, len(home))))
        self._setpoint = home.copy()
        self._wanted = home.copy()
        self.bus.sense = self._sense_one
        self._take_state()
        self._sense(0)
        for joint in self.joints:
            joint.begin()

    @property
    def true_position(self) -> FloatArray:
        """True positions of the joints, (J,) [rad]; never on the wire."""
        return np.array(self._batch.true_joints(self._batch.position)[0])

    def turn(self, joint: str, position: float | None) -> None:
        """Hold a joint at a position [rad] as by hand, from the next tick on; None lets it go.

        Raises:
            ValueError: Its motor has torque.
        """
        j = self._description.joint_names.index(joint)
        if self.joints[j].torque != OFF and position is not None:
            raise ValueError(f"{joint} has torque; nobody turns it by hand")
        self._hands.pop(j, None)
        if position is not None:
            self._hands[j] = position

    @property
    def device_ns(self) -> int:
        """Device time of the next tick or answer [ns]."""
        tick_ns, reply_ns = self._tick * self._tick_ns, self.bus.next_ns
        return tick_ns if reply_ns is None else min(tick_ns, max(reply_ns, self._now_ns))

    @property
    def armed(self) -> bool:
        """Whether all motors follow their goals."""
        return all(joint.torque == ON for joint in self.joints)

    @property
    def mode(self) -> str:
        """State of the motors, one word."""
        if self.watchdog:
            return "stopped"
        states = {joint.torque for joint in self.joints}
        if states == {ON}:
            return "armed"
        return "braking" if states == {DAMPING} else "partly" if ON in states else "idle"

    @property
    def watchdog(self) -> bool:
        """Whether a servo's watchdog has stopped it."""
        return any(joint.stopped for joint in self.joints)

    @property
    def trouble(self) -> str:
        """Current fault of a servo; "" for none."""
        found = (joint.trouble(self._now_ns) for joint in self.joints)
        return next((trouble for trouble in found if trouble), self._bus_trouble or self.joint_faults.now)

    @property
    def frame_errors(self) -> int:
        """Corrupt packets received so far."""
        return self.bus.errors

    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the packets that they complete."""
        self.received_bytes += len(data)
        if data:
            self._sense(self._now_ns)
            self.bus.receive(data)
            self._stale = True
        self._take_goals(self._now_ns)

    def advance_to(self, device_ns: int) -> bytes:
        """Run all ticks and answers up to and including a time [ns]; return the bytes sent meanwhile."""
        out = bytearray()
        while self.device_ns <= device_ns:
            out += self.tick()
        self.set_time(device_ns)
        return bytes(out)

    def tick(self) -> bytes:
        """Run the next tick or answer; return the bytes sent."""
        self.set_time(self.device_ns)
        reply_ns = self.bus.next_ns
        if reply_ns is not None and reply_ns <= self._now_ns < (self._tick + 1) * self._tick_ns:
            return self.bus.take_reply()
        self._step()
        return b""

    def set_time(self, device_ns: int) -> None:
        """Take the time [ns], after all ticks up to it."""
        self.bus.now_ns = self._now_ns = max(self._now_ns, device_ns)

    def _schedule(self, faults: ArmFaults) -> list[tuple[float, Callable[[], None]]]:
        """Return the faults in the order of their times after the first torque [s]."""
        servo = self._servos[-1].id if faults.faulty_servo is None else faults.faulty_servo
        if servo not in self._of_id:
            raise ConfigurationError(
                f"--faulty-servo {servo}: no servo has this id; the robot has {sorted(self._of_id)}"
            )
        joint = self.joints[self._of_id[servo]]
        acts: list[tuple[float | None, Callable[[], None]]] = [
            (faults.servo_absent_after_s, lambda: joint.unplug(self._now_ns)),
            (faults.servo_reboot_after_s, lambda: joint.restart(self._now_ns)),
            (faults.servo_overload_after_s, joint.overload),
            (faults.duplicate_id_after_s, lambda: self.double(joint)),
            (faults.foreign_writer_after_s, lambda: self.let_write(joint, faults)),
        ]
        return sorted(((at_s, act) for at_s, act in acts if at_s is not None), key=lambda due: due[0])

    def _fail(self) -> None:
        """Apply the faults that are due."""
        if self._first_ns is None and self.armed:
            self._first_ns = self._now_ns
        while self._first_ns is not None and self._due:
            if self._now_ns - self._first_ns < round(self._due[0][0] * 1e9):
                return
            self._due.pop(0)[1]()

    def double(self, joint: EmulatedJoint) -> None:
        """Plug in a second servo with a servo's id."""
        self.bus.servos.append(joint.servo.twin())
        self._bus_trouble = DOUBLED

    def let_write(self, joint: EmulatedJoint, faults: BusFaults) -> None:
        """Let another program write a servo's goals."""
        # Towards the middle of its ticks.
        goal = joint.goal + (WAY_TICKS if joint.goal < TICKS // 2 else -WAY_TICKS)
        self._other = OtherMaster(joint.goal_packet(goal), self.bus, faults, self._now_ns)
        self._bus_trouble = FOREIGN

    def mend_bus(self) -> None:
        """Unplug the second servo, and end the other program."""
        self.bus.servos[len(self.joints) :] = []
        self._other, self._bus_trouble = None, ""

    def _step(self) -> None:
        now_ns = self._tick * self._tick_ns
        if self._due:
            self._fail()
        if self.armed:
            self.joint_faults.begin(now_ns)
        if self.joint_faults.advance(now_ns) is not None:
            self._stale = True
        if self._other is not None and self._other.advance(now_ns):
            self._take_goals(now_ns)
        for joint in self.joints:
            joint.tick(now_ns, now_ns - self.bus.alive_ns)
        while self._coming and self._coming[0][0] <= self._tick:
            self._setpoint, self._stale = self._coming.popleft()[1].copy(), True
        if self._stale:
            self._command()
            self._stale = False
        held = self._batch.position.copy() if self.joint_faults.held else None
        self._batch.advance(self._setpoint[None, None, self._actuated])
        if held is not None:
            self._batch.set_state(held, np.zeros_like(held))
        self._hold()
        self._take_state()
        self._tick += 1
        if self._tick % _LOOK_TICKS == 0:
            self._sense(self._now_ns)
            # What the servos do by themselves: protections, watchdogs.
            self._take_goals(self._now_ns)
            self._stale = True

    def _take_state(self) -> None:
        """Note the state after a physics step."""
        self._position, self._velocity = self._batch.position[0].copy(), self._batch.velocity[0].copy()
        self._torque = self._effort[0, self._dofs].copy()

    def _hold(self) -> None:
        """Leave the joints where hands hold them."""
        self._hands = {j: at for j, at in self._hands.items() if self.joints[j].torque == OFF}
        if self._hands:
            held = list(self._hands)
            position, velocity = self._batch.position.copy(), self._batch.velocity.copy()
            position[0, held], velocity[0, held] = list(self._hands.values()), 0.0
            self._batch.set_state(position, velocity)

    def _take_goals(self, now_ns: int) -> None:
        """Take the servos' goals; they act from the first physics step that begins after the latency."""
        told = zip(self._servos, self.joints, strict=True)
        wanted = np.array([servo.position(joint.goal) for servo, joint in told])
        if not np.array_equal(wanted, self._wanted):
            self._wanted = wanted
            due = math.ceil((now_ns + self._latency_ns) / self._tick_ns - 1e-6)
            self._coming.append((max(due, self._coming[-1][0] if self._coming else 0), wanted))

    def _command(self) -> None:
        """Set gains and limits as the servos' registers say."""
        d = self._description
        kp, kd, effort = np.array(d.stiffness), np.array(d.damping), np.array(d.effort_limit)
        for a, j in enumerate(self._actuated):
            joint, servo = self.joints[j], self._servos[j]
            if joint.torque != ON:
                kp[a], kd[a] = 0.0, BRAKE if joint.torque == DAMPING else 0.0
                # With torque again, the set-point begins where the joint is.
                self._held.pop(int(j), None)
                continue
            kp[a] *= joint.gains.p / servo.p_gain
            kd[a] *= joint.gains.d / servo.d_gain if servo.d_gain else 1.0
            effort[a] *= joint.share
            if joint.stopped:
                self._setpoint[j] = self._held.setdefault(int(j), float(self._position[j]))
            else:
                self._held.pop(int(j), None)
        if self.joint_faults.limp:
            kp, kd = np.zeros_like(kp), np.zeros_like(kd)
        sent = (*kp, *kd, *effort)
        if sent != self._sent:
            self._sent = sent
            self._batch.set_sent(kp, kd, effort)

    def _sense(self, now_ns: int) -> None:
        """Set the registers of what the servos measure at a time [ns]."""
        for j in range(len(self.joints)):
            self._measure(j, now_ns)

    def _sense_one(self, servo: int, now_ns: int) -> None:
        """The same of the servo with an id."""
        j = self._of_id.get(servo)
        if j is not None:
            self._measure(j, now_ns)

    def _measure(self, j: int, now_ns: int) -> None:
        """Set the registers of a joint's servo.

        A servo samples faster than a physics step: between two steps the joint moves on at its velocity.
        """
        faults = self.joint_faults
        if faults.frozen[j]:
            return
        joint, servo = self.joints[j], self._servos[j]
        shown, sign = int(faults.source[j]), float(faults.sign[j])
        velocity = sign * float(self._velocity[shown])
        position = (
            sign * float(self._position[shown]) + 1e-9 * (now_ns - self._tick * self._tick_ns) * velocity
        )
        if faults.outside[j]:
            position = float(faults.beyond[j])
        if self._noisy:
            position += self._rng.standard_normal() * self._description.sensor.noise[j]
        most = self._most[j]
        duty = servo.direction * float(self._torque[j]) / most if most and joint.torque == ON else 0.0
        joint.sense(servo.ticks(position), servo.direction * velocity / RAD, min(max(duty, -1.0), 1.0))
