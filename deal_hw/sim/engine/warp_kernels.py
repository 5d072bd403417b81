"""Kernels around a step of MuJoCo Warp: controls, laws of joints, and records. Importing this loads Warp.

A world is a member in a window: world ``g N + n`` is member n of N in window g.
"""

import warp as wp


@wp.kernel
def set_control(
    step: wp.array[int],
    control: wp.array4d[wp.float64],
    nu: int,
    ctrl: wp.array2d[float],
    applied: wp.array2d[float],
) -> None:
    """Set controls and applied forces of this step from (N, G, S, nu or nu + nv)."""
    w, i = wp.tid()
    members = control.shape[0]
    value = float(control[w % members, w // members, step[0], i])
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
