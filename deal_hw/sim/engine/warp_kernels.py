"""Kernels around a step of MuJoCo Warp: controls, laws of joints, and records. Importing this loads Warp.

A world is a member in a window: world ``g N + n`` is member n of N in window g.
"""

import warp as wp

vec10 = wp.types.vector(length=10, dtype=float)
"""Parameters of an actuator's gain or bias."""


@wp.kernel
def set_control(
    step: wp.array[int],
    control: wp.array2d[wp.float64],
    members: int,
    windows: int,
    nu: int,
    ctrl: wp.array2d[float],
    applied: wp.array2d[float],
) -> None:
    """Set controls and applied forces of this step from the first N G S rows, (..., nu or nu + nv)."""
    w, i = wp.tid()
    row = ((w % members) * windows + w // members) * step[1] + step[0]
    value = float(control[row, i])
    if i < nu:
        ctrl[w, i] = value
    else:
        applied[w, i - nu] = value


@wp.kernel
def friction(
    members: int,
    dof: wp.array[int],
    coefficient: wp.array3d[float],
    loaded: int,
    least: float,
    qvel: wp.array2d[float],
    torque: wp.array2d[float],
    bias: wp.array2d[float],
    loss: wp.array2d[float],
) -> None:
    """Write the friction of :class:`deal_hw.sim.laws.friction.FrictionLaw`; coefficients are (7, N, D)."""
    w, d = wp.tid()
    n = w % members
    at = dof[d]
    ratio = qvel[w, at] / coefficient[2, n, d]
    slow = wp.exp(-ratio * ratio)
    moving = coefficient[0, n, d]
    rest = coefficient[1, n, d]
    if loaded == 1:
        motor = torque[w, at]
        outside = -bias[w, at]
        moving += wp.abs(coefficient[4, n, d] * outside - coefficient[3, n, d] * motor)
        rest += wp.abs(coefficient[6, n, d] * outside - coefficient[5, n, d] * motor)
    loss[w, at] = wp.max(moving + slow * rest, least)


@wp.kernel
def effort_limits(
    members: int,
    actuator: wp.array[int],
    driven: wp.array[int],
    turns: wp.array[float],
    stall: wp.array2d[float],
    free_speed: wp.array2d[float],
    qvel: wp.array2d[float],
    limit: wp.array2d[wp.vec2],
) -> None:
    """Write the efforts of :func:`deal_hw.sim.laws.motor.effort_range`."""
    w, b = wp.tid()
    n = w % members
    most = stall[n, b]
    lost = most * (qvel[w, driven[b]] * turns[b] / free_speed[n, b])
    limit[w, actuator[b]] = wp.vec2(-most - lost, most - lost)


@wp.func
def counted(reading: float, count: float) -> float:
    """Return a reading in whole counts; as it is without any."""
    whole = reading
    if count > 0.0:
        whole = wp.rint(reading / count) * count
    return whole


@wp.kernel
def servo_efforts(
    members: int,
    actuator: wp.array[int],
    place: wp.array[int],
    servo: wp.array2d[float],
    law: wp.array3d[float],
    margin: float,
    ctrl: wp.array2d[float],
    qpos: wp.array2d[float],
    bias: wp.array2d[vec10],
) -> None:
    """Write the constant efforts of :class:`deal_hw.sim.engine.servo_firmware.ServoFirmware`.

    ``servo`` has gear, goal at a ``ctrl`` of 1, own constant effort and both ends of ``ctrl``, (5, B).
    ``law`` has the parts of `ServoLaw`, (5, N, B).
    """
    w, b = wp.tid()
    n = w % members
    a = actuator[b]
    gear = servo[0, b]
    gain = -bias[w, a][1]
    goal = wp.clamp(ctrl[w, a], servo[3, b], servo[4, b]) * servo[1, b]
    position = qpos[w, place[b]]
    scale = law[3, n, b]
    read = counted(scale * position + law[4, n, b], law[0, n, b])
    error = counted(scale * goal + law[4, n, b], law[0, n, b]) - read
    beyond = wp.abs(error) - law[1, n, b]
    acting = 0.0
    if beyond > margin:
        acting = wp.sign(error) * (beyond / scale + law[2, n, b] / (gain * gear * gear))
    bias[w, a][0] = servo[2, b] + gain * gear * (acting - (goal - position))


@wp.kernel
def record(step: wp.array[int], every: int, values: wp.array2d[float], out: wp.array3d[float]) -> None:
    """Write values, (worlds, F), into (S // every, worlds, F) after each ``every``-th step."""
    w, f = wp.tid()
    done = step[0] + 1
    if done % every == 0:
        out[done // every - 1, w, f] = values[w, f]


@wp.kernel
def count(step: wp.array[int]) -> None:
    """Count one step."""
    step[0] = step[0] + 1
