"""A change that command and measurement share: order, sign and scale of joints, and the clock.

Comparing command and measurement does not show such an error. After the change is undone, a model can predict
the recording.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.sim.recordings.episode import SampledEpisode


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelChange:
    """A change of all joint channels of a fixed-base robot: x of joint j becomes ``scale[j] * x[source[j]]``.

    Attributes:
        source: Source joint of each joint, a permutation, (J,).
        scale: Factors, (J,); efforts take the sign only.
        clock: Factor of all times [-].
    """

    source: tuple[int, ...]
    scale: tuple[float, ...]
    clock: float = 1.0

    @classmethod
    def none(cls, joints: int) -> ChannelChange:
        """Return the identity."""
        return cls(source=tuple(range(joints)), scale=(1.0,) * joints)

    @property
    def inverse(self) -> ChannelChange:
        """The change that undoes this one."""
        back = np.argsort(self.source)
        scale = tuple(1.0 / self.scale[k] for k in back)
        return ChannelChange(source=tuple(map(int, back)), scale=scale, clock=1.0 / self.clock)

    def then(self, after: ChannelChange) -> ChannelChange:
        """Return this change followed by ``after``, as one change."""
        return ChannelChange(
            source=tuple(self.source[k] for k in after.source),
            scale=tuple(s * self.scale[k] for s, k in zip(after.scale, after.source, strict=True)),
            clock=after.clock * self.clock,
        )

    def of(self, episode: SampledEpisode, actuated: Sequence[int], *, efforts: bool) -> SampledEpisode:
        """Return the changed recording of a fixed-base robot; gains and limits stay.

        Only the actuated joints, (A,), exchange commands. ``efforts``: commands are efforts, not positions.
        """
        joints, scale = list(self.source), np.array(self.scale)
        actuators = [list(actuated).index(self.source[joint]) for joint in actuated]
        sent = np.sign(scale) if efforts else scale
        return dataclasses.replace(
            episode,
            step_s=self.clock * episode.step_s,
            position=scale * episode.position[:, joints],
            velocity=scale / self.clock * episode.velocity[:, joints],
            target=sent[list(actuated)] * episode.target[:, actuators],
            start_setpoint=sent[list(actuated)] * episode.start_setpoint[actuators],
        )

    def on(self, problem: Problem, episodes: Sequence[SampledEpisode]) -> Problem:
        """Return the problem of changed recordings of a fixed-base robot, with the noise scaled alike."""
        facts, robot = problem.robot.description, problem.robot
        motor = facts.actuation == "motor"
        changed = [self.of(e, facts.actuated_index, efforts=motor) for e in episodes]
        joints, scale = list(self.source), np.abs(self.scale)
        position, velocity = np.split(problem.noise_std, 2)
        std = np.concatenate([scale * position[joints], scale / self.clock * velocity[joints]])
        # A device period is a whole number of physics steps.
        steps = changed[0].step_s / robot.step_s
        if abs(steps - round(steps)) < 1e-6 and round(steps) >= 1:
            return problem.on(changed, std)
        robot = dataclasses.replace(robot, model=copy.copy(robot.model))
        robot.model.opt.timestep = changed[0].step_s / math.ceil(steps)
        return dataclasses.replace(problem, robot=robot, episodes=changed, known_std=std)
