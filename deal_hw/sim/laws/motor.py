"""The effort that a motor has left at a speed, for a limited voltage."""

from __future__ import annotations

from deal_hw.types import FloatArray


def effort_range(
    speed: FloatArray, stall: FloatArray, free_speed: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the least and largest effort of motors at a speed.

    A DC motor on a voltage U between -V and V has the torque ``kt U / R - kt² w / R``. With the torque at
    standstill ``stall = kt V / R`` and the speed without load ``free_speed = V / kt`` this lies between
    ``-stall (1 + w / free_speed)`` and ``stall (1 - w / free_speed)``. Faster than that it brakes.

    Args:
        speed: Speeds w, (N, A) [rad/s or m/s].
        stall: Efforts at standstill, (N, A) [N·m or N].
        free_speed: Speeds without load, (N, A) [rad/s or m/s]; infinite for a limit that does not change.

    Returns:
        Both ends, (N, A) each [N·m or N].
    """
    lost = stall * (speed / free_speed)
    return -stall - lost, stall - lost
