"""A simulated arm of three joints that follows sums of sines: recordings whose truth is known."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

JOINTS = ("yaw", "pitch", "elbow")
MJCF = """<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="shoulder" pos="0 0 0.1">
      <joint name="yaw" axis="0 0 1" damping="0.2" armature="0.01"/>
      <inertial pos="0 0 0.03" mass="0.5" diaginertia="0.0006 0.0006 0.0005"/>
      <body name="upper" pos="0 0 0.06">
        <joint name="pitch" axis="0 1 0" damping="0.2" armature="0.01"/>
        <inertial pos="0 0 0.12" mass="0.8" diaginertia="0.005 0.0048 0.0008"/>
        <body name="lower" pos="0 0 0.25">
          <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.008"/>
          <inertial pos="0.01 0 0.1" mass="0.5" diaginertia="0.002 0.0019 0.0004"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw" joint="yaw" kp="20" kv="1"/>
    <position name="pitch" joint="pitch" kp="30" kv="1.5"/>
    <position name="elbow" joint="elbow" kp="15" kv="0.7"/>
  </actuator>
</mujoco>
"""
PERIOD_S = 0.01
NOISE_RAD = 2e-4


TORQUE_NOISE = 0.02
COLUMNS = """time: {column: time, unit: s}
joints:
  - {name: yaw, position: yaw_pos, target: yaw_cmd, effort: yaw_torque}
  - {name: pitch, position: pitch_pos, target: pitch_cmd, effort: pitch_torque}
  - {name: elbow, position: elbow_pos, target: elbow_cmd, effort: elbow_torque}
"""
"""Column map of the recordings."""


def record(
    model: mujoco.MjModel,
    path: Path,
    seed: int,
    seconds: float = 4.0,
    *,
    gain: float = 1.0,
    bias: float = 0.0,
    delay_steps: int = 0,
) -> Path:
    """Write a CSV recording of the arm and return its path: time, positions, commands, torques of the motors.

    Args:
        model: The true arm.
        path: The file.
        seed: Of the motion and the noise.
        seconds: Its length.
        gain: Of the torque sensors.
        bias: Of the torque sensors [N·m].
        delay_steps: Physics steps by which their reports are older than those of positions.
    """
    rng, data, count = np.random.default_rng(seed), mujoco.MjData(model), round(seconds / PERIOD_S)
    frequency, phase = rng.uniform(0.2, 2.5, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
    amplitude = rng.uniform(0.1, 0.35, (6, 3))
    time_s = np.arange(count) * PERIOD_S
    angle = 2 * np.pi * frequency * time_s[:, None, None] + phase
    # All begin at 0, where the arm stands.
    command = np.sum(amplitude * (np.sin(angle) - np.sin(phase)), axis=1)
    position, torque = np.empty((2, count, len(JOINTS)))
    # Torques of the last steps, the oldest first.
    last = [np.zeros(len(JOINTS))] * (delay_steps + 1)
    for k in range(count):
        position[k], torque[k], data.ctrl[:] = data.qpos, last[0], command[k]
        for _ in range(round(PERIOD_S / model.opt.timestep)):
            mujoco.mj_step(model, data)
            last = [*last[1:], np.array(data.qfrc_actuator)]
    position += NOISE_RAD * rng.standard_normal(position.shape)
    torque = gain * (torque + TORQUE_NOISE * rng.standard_normal(torque.shape)) + bias
    columns = ["time", *(f"{joint}_{what}" for what in ("pos", "cmd", "torque") for joint in JOINTS)]
    table = np.concatenate([time_s[:, None], position, command, torque], axis=1)
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="")
    return path
