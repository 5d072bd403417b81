"""The Go2's canter: a gait of three beats by a contact schedule, ahead, behind the safety filter."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import ndtr

from deal_hw.errors import ConfigurationError
from deal_hw.policies.go2_env import Go2Env, WalkTask
from deal_hw.policies.reference_motion import ReferenceMotion
from deal_hw.policies.vector_env import check_task
from deal_hw.types import FloatArray

REFERENCE: Final = Path(__file__).parent / "assets" / "go2_canter_motion.npz"
"""The shipped canter of the nominal robot under drawn commands: tools/make_reference_motion.py."""
_OF_GAIT: Final = (
    "gait_weight",
    "schedule_weight",
    "slip_weight",
    "tilt_weight",
    "height_weight",
    "bounce_weight",
    "roll_weight",
    "hip_weight",
)
"""Weights of rewards that say how to move, where a reference motion does not."""
NEAR_M: Final = 0.01
"""Height of a foot's sole at which it no longer counts as a contact; between this and the floor it counts in
part. The batched engine has no contact sensor, and the floor gives way by less than a millimetre."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactSchedule:
    """When each foot is to be on the floor, in turns of a clock.

    The order of the beats is that of a canter on the right lead: left hind foot, then right hind and left
    fore together, then right fore; suspension follows at high speed (Fletcher and Datt, Canine Gaits,
    vanat.cvm.umn.edu/mGaits). The clock's zero is arbitrary: it is chosen such that the pair of the middle
    beat comes down as in the shipped trot, so that the canter can be learnt from it. Distances of 0.3 turns
    between the beats, the duty and the clock's rate are this project's choice: at 1.5 m/s a foot on the floor
    then moves back by 0.27 m, which legs of 0.43 m reach. A duty above 0.4 leaves no suspension: it is a
    slow, collected canter, in which a foot has time to carry the weight.

    Attributes:
        touchdown: Phase at which each foot comes down, FL, FR, RL, RR [turns].
        duty: Share of a stride in which a foot is on the floor.
        width: Standard deviation by which the edges of a contact are smoothed in the reward [turns].
    """

    touchdown: tuple[float, ...] = (0.5, 0.8, 0.2, 0.5)
    duty: float = 0.55
    width: float = 0.05

    def __post_init__(self) -> None:
        if not all(0 <= phase < 1 for phase in self.touchdown):
            raise ConfigurationError(f"touchdown must lie in [0, 1) turns, got {self.touchdown}")
        if not 0 < self.duty < 1:
            raise ConfigurationError(f"duty must lie in (0, 1), got {self.duty!r}")
        if not self.width > 0:
            raise ConfigurationError(f"width must be positive, got {self.width!r}")

    def since_touchdown(self, clock: FloatArray) -> FloatArray:
        """Return the time since each foot's touchdown, (N, F) [turns], at phases (N,)."""
        return np.asarray((clock[:, None] - np.array(self.touchdown)) % 1.0)

    def stance(self, clock: FloatArray) -> FloatArray:
        """Return whether each foot is to be on the floor, (N, F): 1 or 0."""
        return np.where(self.since_touchdown(clock) < self.duty, 1.0, 0.0)

    def smooth_stance(self, clock: FloatArray) -> FloatArray:
        """Return how much each foot is to be on the floor, (N, F) in 0 to 1, with smoothed edges.

        The form is that of Walk These Ways (Margolis and Agrawal, 2022): a product of normal distributions.
        """
        since = self.since_touchdown(clock)
        found = np.zeros_like(since)
        for turn in (-1.0, 0.0, 1.0):
            begun = ndtr((since + turn) / self.width)
            found += begun * (1.0 - ndtr((since + turn - self.duty) / self.width))
        return found

    def swing_share(self, clock: FloatArray) -> FloatArray:
        """Return the share of each foot's swing that is over, (N, F); below 0 in stance."""
        return np.asarray((self.since_touchdown(clock) - self.duty) / (1.0 - self.duty))


@dataclass(frozen=True, slots=True, kw_only=True)
class CanterTask(WalkTask):
    """Settings of the canter, those of the walk with other values.

    Attributes:
        schedule: When each foot is to be on the floor; ``swing_share`` is not used.
        schedule_weight: Cost of a foot that is on the floor in its swing, or in the air in its stance, mean
            over the feet.
    """

    schedule: ContactSchedule = ContactSchedule()
    schedule_weight: float = 5.0
    swing_m: float = 0.07
    command_range: tuple[tuple[float, float], ...] = ((0.5, 1.5), (0.0, 0.0), (-0.5, 0.5))
    zeroed: float = 0.0
    tracking_weight: float = 2.0
    tracking_width: float = 0.25
    height_weight: float = 10.0
    height_m: float = 0.28
    bounce_weight: float = 0.1
    roll_weight: float = 0.01

    def __post_init__(self) -> None:
        # A class with slots has no super() without arguments.
        WalkTask.__post_init__(self)
        check_task(self, not_negative=("schedule_weight",))


class CanterEnv(Go2Env):
    """Follow a velocity ahead and a yaw rate in a canter, behind the safety filter.

    The reward of a tick is that of the walk (:class:`~deal_hw.policies.go2_env.Go2Env`), where the wanted
    height of a foot follows the schedule: zero in its stance, half a sine of ``swing_m`` in its swing, less::

        schedule_weight mean over feet of |c - C|

    where c is 1 for a foot on the floor and falls to 0 at a height of ``NEAR_M``, and C is the schedule with
    smoothed edges; C is 1 for all feet where the command is to stand.

    Args:
        description: The robot's description of its driver: with feet, and with limits for legs.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.

    Raises:
        ConfigurationError: The description does not name four feet.
    """

    task: CanterTask
    task_type = CanterTask

    def imitate(self) -> ReferenceMotion:
        """Leave the gait to the shipped canter: of the rewards stay commands, safety and falls."""
        found = ReferenceMotion.read(REFERENCE)
        found.check(self.motion_names(), self.description.control_rate_hz)
        none: Any = dict.fromkeys(_OF_GAIT, 0.0)
        self.task = dataclasses.replace(self.task, **none)
        return found

    def contacts(self) -> FloatArray:
        """Return how much each foot is on the floor, (N, F) in 0 to 1."""
        height = self._feet_now()[..., 2] - self._radius
        return np.asarray(np.clip(1.0 - height / NEAR_M, 0.0, 1.0))

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        reward = super().reward(position, velocity, action, before)
        moving = np.any(self.command != 0.0, axis=1)
        wanted = np.where(moving[:, None], self.task.schedule.smooth_stance(self._builder.clock), 1.0)
        wrong = np.abs(self.contacts() - wanted).mean(axis=1)
        self._note(off_schedule=np.nanmean(wrong))
        return np.asarray(reward - self.task.schedule_weight * wrong)

    def _wanted_heights(self) -> FloatArray:
        share = self.task.schedule.swing_share(self._builder.clock)
        return np.where(share > 0.0, self.task.swing_m * np.sin(np.pi * np.maximum(share, 0.0)), 0.0)
