"""Sensors of an emulated quadruped: the mechanics with noise, bias and quantisation."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from deal_hw.drivers.go2.emulator.motors import Motors
from deal_hw.drivers.unitree.emulated_imu import roll_pitch_yaw, turned
from deal_hw.drivers.unitree.emulated_quadruped import BatteryFacts, QuadrupedProfile, QuadrupedTruth
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.testing.joint_faults import FaultyJoints
from deal_hw.types import FloatArray

_CELL_V: Final = 3.7
IMU_TEMPERATURE_C: Final = 58
_HOT_C: Final = 95
_LOW_CHARGE: Final = 0.04


class Battery:
    """A battery that the motors drain.

    Attributes:
        charge: State of charge, 0 to 1.
        current: Present current [A].

    Args:
        facts: Its cells, capacity and losses.
    """

    def __init__(self, facts: BatteryFacts) -> None:
        self._facts = facts
        self.charge = 0.86
        self.current = facts.idle_a

    @property
    def cell_mv(self) -> int:
        """Voltage of one cell [mV]."""
        return round(3200 + 780 * self.charge)

    @property
    def voltage(self) -> float:
        """Voltage of the supply under load [V]."""
        return self._facts.cells * self.cell_mv * 1e-3 - self._facts.resistance_ohm * self.current

    def drain(self, effort: FloatArray, velocity: FloatArray, seconds: float) -> None:
        """Deliver the motors' power for a time [s]."""
        facts = self._facts
        watts = max(0.0, float(effort @ velocity)) + facts.loss_w_nm2 * float(effort @ effort)
        self.current = facts.idle_a + watts / (facts.cells * _CELL_V)
        self.charge = max(0.0, self.charge - self.current * seconds / (3600.0 * facts.capacity_ah))


class Sensing:
    """Makes LowStates from the mechanics, with the faults of broken sensors.

    Attributes:
        battery: The battery.
        motors: The motors.
        hot: Joint whose motor reports 95 °C; None for none.
        broken: Joint whose encoder reports NaN; None for none.

    Args:
        sim: The mechanics.
        motors: The motors.
        truth: Encoder biases, and the battery.
        profile: Noise and resolution.
        rng: Source of the noise.
        joints: Faults of the joints.
    """

    def __init__(
        self,
        sim: LeggedSimulation,
        motors: Motors,
        truth: QuadrupedTruth,
        profile: QuadrupedProfile,
        rng: np.random.Generator,
        joints: FaultyJoints,
    ) -> None:
        self._joint_faults = joints
        self.battery = Battery(truth.machine.battery)
        self.hot: int | None = None
        self.broken: int | None = None
        self._sim, self.motors, self._rng = sim, motors, rng
        self._bias = np.array(truth.encoder_bias)
        self._resolution = profile.position_resolution
        p = profile
        self._noise = np.repeat(
            (
                p.position_noise,
                p.velocity_noise,
                p.acceleration_noise,
                p.effort_noise,
                p.orientation_noise,
                p.gyro_noise,
                p.specific_force_noise,
            ),
            (12, 12, 12, 12, 3, 3, 3),
        )
        self._cells, self._in_series = np.zeros(15, np.int64), truth.machine.battery.cells

    def empty_battery(self) -> None:
        """Set the battery's charge to 4 %."""
        self.battery.charge = min(self.battery.charge, _LOW_CHARGE)

    def state(self, tick_ms: int, remote: bytes) -> LowState:
        """Return the present state.

        Args:
            tick_ms: The robot's clock.
            remote: The remote control's 40 bytes.
        """
        sim, motors, battery = self._sim, self.motors, self.battery
        noise = self._noise * self._rng.standard_normal(57)
        position = sim.position() + self._bias + noise[0:12]
        if self._resolution:
            position = np.rint(position / self._resolution) * self._resolution
        position, velocity = self._joint_faults.read(position, sim.velocity() + noise[12:24])
        temperature = motors.temperature.astype(np.int64)
        if self.hot is not None:
            temperature[self.hot] = _HOT_C
        if self.broken is not None:
            position[self.broken] = velocity[self.broken] = math.nan
        w, x, y, z = orientation = turned(sim.orientation(), noise[48:51])
        force = np.rint(np.minimum(sim.foot_force(), 32767.0)).astype(np.int64)
        self._cells[: self._in_series] = battery.cell_mv
        return LowState(
            position=position,
            velocity=velocity,
            acceleration=sim.acceleration() + noise[24:36],
            effort=motors.effort + noise[36:48],
            temperature=temperature,
            lost=motors.lost,
            mode=motors.mode,
            orientation=orientation,
            angular_velocity=sim.angular_velocity() + noise[51:54],
            specific_force=sim.specific_force() + noise[54:57],
            rpy=roll_pitch_yaw(w, x, y, z),
            imu_temperature=IMU_TEMPERATURE_C,
            foot_force=force,
            foot_force_estimate=force,
            tick_ms=tick_ms,
            remote=remote,
            battery_percent=round(100 * battery.charge),
            battery_current_ma=-round(1e3 * battery.current),
            battery_status=8,
            battery_cycles=42,
            cell_voltage_mv=self._cells,
            voltage=battery.voltage,
            current=battery.current,
        )
