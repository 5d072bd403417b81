"""An emulated robot's motors: a PD loop at 1 kHz on the last command, which they hold for ever."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.motor_command import MODE_SERVO, POSITION_STOP, VELOCITY_STOP, MotorCommand
from deal_hw.types import FloatArray, IntArray

AMBIENT_C: Final = 28.0
ServoModes = Sequence[int | Sequence[int]]
"""Modes in which motors follow commands: each a number for all of them, or one for each motor, (J,)."""
HEAT_K_NM2: Final = 0.25
_WARMING_S: Final = 150.0


class PdMotors:
    """Motors in model order. There is no watchdog: the last command holds until the next.

    Until the first command they are off, as after power-up.

    Attributes:
        mode: Mode of each motor as commanded last, (J,).
        lost: Commands that each motor missed, (J,).
        temperature: (J,) [°C].
        effort: Efforts at the start of a step, (J,) [N·m].
        constant: The part of the effort that is constant through the step, (J,) [N·m].
        brake: The rest as damping, which falls as the joint slows down within the step, (J,) [N·m·s/rad].

    Args:
        stiffness: True kp over commanded kp, (J,).
        damping: The same for kd, (J,).
        bias: Reported minus true position, (J,) [rad].
        limit: Largest effort, (J,) [N·m].
        no_load: Speed without load, (J,) [rad/s].
        knee: Share of that speed up to which a motor gives full torque; from there it falls linearly. 1: full
            torque at any speed.
        servo_modes: Modes in which a motor follows commands; in any other it is off.
        heat_k_nm2: Final warming for the square of the torque [K/(N·m)²].
    """

    def __init__(
        self,
        stiffness: Sequence[float],
        damping: Sequence[float],
        bias: Sequence[float],
        limit: Sequence[float],
        no_load: Sequence[float],
        knee: float,
        servo_modes: ServoModes = (MODE_SERVO,),
        heat_k_nm2: float = HEAT_K_NM2,
    ) -> None:
        count = len(stiffness)
        self._stiffness_factor, self._damping_factor = np.array(stiffness), np.array(damping)
        self._bias, self._limit, self._no_load = np.array(bias), np.array(limit), np.array(no_load)
        self._knee, self._heat_k_nm2 = knee, heat_k_nm2
        self._servo_modes = np.array([np.full(count, mode) for mode in servo_modes])
        self._q, self._dq, self._kp, self._kd, self._tau = np.zeros((5, count))
        self._alive, self._any_dead = np.ones(count), False
        self.mode: IntArray = np.zeros(count, np.int64)
        self.lost: IntArray = np.zeros(count, np.int64)
        self.temperature = np.full(count, AMBIENT_C)
        self.effort, self.constant, self.brake = np.zeros((3, count))

    def accept(self, command: MotorCommand) -> None:
        """Hold this command from now on."""
        on = (command.mode == self._servo_modes).any(axis=0)
        # The vendor's stop values switch a loop off at any gain.
        position_on = on & (np.abs(command.position) < POSITION_STOP / 2)
        velocity_on = on & (np.abs(command.velocity) < VELOCITY_STOP)
        self._kp = np.where(position_on, command.stiffness * self._stiffness_factor, 0.0)
        self._kd = np.where(velocity_on, command.damping * self._damping_factor, 0.0)
        self._q = np.where(position_on, command.position, 0.0)
        self._dq = np.where(velocity_on, command.velocity, 0.0)
        self._tau = np.where(on, command.effort, 0.0)
        self.mode = command.mode

    @property
    def stiff(self) -> bool:
        """Whether a motor has a stiffness or a torque in force."""
        return bool(self._kp.any() or self._tau.any())

    def lose(self, joint: int) -> None:
        """Disconnect a motor: it gives no torque and misses every command from now on."""
        self._alive[joint] = 0.0
        self._any_dead = True

    def give_no_torque(self) -> None:
        """Make this step's efforts 0; the commands stay."""
        self.effort, self.constant, self.brake = np.zeros((3, len(self.effort)))

    def update(self, position: FloatArray, velocity: FloatArray) -> None:
        """Compute the efforts for true positions and velocities, (J,).

        The D gain becomes damping, which is integrated implicitly. If its torque were held through a step of
        1 ms, high gains, which a real motor takes, would make the light joints unstable.
        """
        constant = self._kp * (self._q - position - self._bias) + self._kd * self._dq + self._tau
        wish = constant - self._kd * velocity
        limit = self._limit
        if self._knee < 1.0:
            share = (1.0 - np.abs(velocity) / self._no_load) / (1.0 - self._knee)
            driving = self._limit * np.minimum(np.maximum(share, 0.0), 1.0)
            # Braking is not limited by the supply's voltage.
            limit = np.where(wish * velocity > 0.0, driving, self._limit)
        free = np.abs(wish) <= limit
        if free.all() and not self._any_dead:
            self.effort, self.constant, self.brake = wish, constant, self._kd
            return
        self.effort = np.minimum(np.maximum(wish, -limit), limit) * self._alive
        # Beyond the limit the effort does not depend on the joint's motion.
        self.constant = np.where(free, constant * self._alive, self.effort)
        self.brake = np.where(free, self._kd * self._alive, 0.0)

    def contents(self) -> bytes:
        """Return the bytes of parameters, command and state: motors with the same ones answer alike."""
        return b"".join(np.asarray(value).tobytes() for value in vars(self).values())

    def warm(self, seconds: float) -> None:
        """Warm the motors by their efforts, and count the commands that dead ones miss."""
        steady = AMBIENT_C + self._heat_k_nm2 * self.effort * self.effort
        self.temperature += (seconds / _WARMING_S) * (steady - self.temperature)
        if self._any_dead:
            # A new array, because earlier states keep the old one.
            self.lost = self.lost + (self._alive == 0.0)
