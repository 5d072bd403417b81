"""Draws hidden truths that a balancer with known parameters can balance."""

from __future__ import annotations

import functools

import numpy as np

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.lqr import TARGET_LIMIT_M, LqrController, design_lqr
from deal_hw.drivers.cartpole.plant.mechanics import START_ANGLE_RAD
from deal_hw.drivers.cartpole.plant.profiles import profile as find_profile
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, candidate_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError, TransportTimeoutError
from deal_hw.motions.behaviours import position_command
from deal_hw.parameters import ParameterSpace

BALANCE_S = 6.0
FALLEN_RAD = 0.3
MAX_DRAWS = 200


def draw_truth(
    profile: str, seed: int, *, range_ratio: float = 5.0, space: ParameterSpace | None = None
) -> CartpoleTruth:
    """Return the hidden truth of a seed: the first draw that the balancer balances.

    Args:
        profile: Name of the profile.
        seed: Seed of the draw.
        range_ratio: Ratio of the range around the nominal parameters.
        space: The drawn parameters and their nominal values; without it K9.

    Raises:
        UnknownNameError: There is no such profile.
        ConfigurationError: ``range_ratio`` is not above 1, or no draw can be balanced.
    """
    find_profile(profile)
    if seed < 0:
        raise ConfigurationError(f"a seed is 0 or more, got {seed}")
    rng = np.random.default_rng([seed, 0x7207])
    for refused in range(MAX_DRAWS):
        truth = candidate_truth(
            profile, rng, seed=seed, range_ratio=range_ratio, refused=refused, space=space
        )
        if oracle_balances(truth):
            return truth
    raise ConfigurationError(
        f"none of {MAX_DRAWS} draws of seed {seed} with range ratio {range_ratio:g} can be balanced in "
        f"profile {profile!r}; use a smaller range ratio"
    )


def oracle_balances(truth: CartpoleTruth) -> bool:
    """Return whether the balancer with the true parameters holds the pole for 6 s from either side.

    The answer takes 0.2 s. Benches and tests draw the same truths again, so the last answers are kept.
    """
    parameters = tuple(truth.parameters.items())
    return _holds(truth.profile, truth.seed, parameters, truth.actuation_ticks, truth.sensing_ticks)


@functools.lru_cache(maxsize=64)
def _holds(
    profile: str,
    seed: int,
    parameters: tuple[tuple[str, float], ...],
    actuation_ticks: int,
    sensing_ticks: int,
) -> bool:
    truth = CartpoleTruth(
        profile=profile,
        seed=seed,
        parameters=dict(parameters),
        actuation_ticks=actuation_ticks,
        sensing_ticks=sensing_ticks,
    )
    found = find_profile(profile)
    # It plans for the mean of the jitter, because single values are unknown in advance.
    latency_ticks = actuation_ticks + sensing_ticks + round(found.mean_jitter_ticks)
    controller = design_lqr(truth.parameters, latency_ticks, found.sensor)
    return all(balances(truth, controller, angle) for angle in (START_ANGLE_RAD, -START_ANGLE_RAD))


def balances(truth: CartpoleTruth, controller: LqrController, start_angle_rad: float) -> bool:
    """Return whether |angle| stays below 0.3 rad and the cart in the target range, over the real wire."""
    clock = VirtualClock()
    device = CartpoleDevice(truth, start_angle_rad=start_angle_rad)
    robot = CartpoleRobot(VirtualTransport(device, clock), clock)
    robot.connect()
    robot.home(timeout_s=2.0)
    robot.arm(timeout_s=1.0)
    controller.reset()
    period_ns = round(1e9 / DESCRIPTION.control_rate_hz)
    deadline_ns = clock.now_ns()
    for _ in range(round(BALANCE_S * DESCRIPTION.control_rate_hz)):
        deadline_ns += period_ns
        position = _newest_position(robot, clock, deadline_ns)
        if position is not None:
            robot.send_command(position_command(DESCRIPTION, np.array([controller.act(position)])))
        cart, pole = device.true_position
        if abs(pole) >= FALLEN_RAD or abs(cart) >= TARGET_LIMIT_M:
            return False
    return True


def _newest_position(robot: CartpoleRobot, clock: VirtualClock, deadline_ns: int) -> np.ndarray | None:
    position = None
    while True:
        try:
            position = robot.read_state(max(0, deadline_ns - clock.now_ns()) / 1e9).position
        except TransportTimeoutError:
            return position
