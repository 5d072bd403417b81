"""A policy without a network: state feedback, for tests of code that runs policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.policy import Observation, ObservationTerm, PolicySpec, Quantity
from deal_hw.types import FloatArray

CARTPOLE_GAINS = (1.65, 1.04, 0.475, 0.171)
"""Balances the nominal cart-pole: target per cart position, pole angle and their rates."""


def feedback_spec(description: RobotDescription) -> PolicySpec:
    """Return the spec of a policy that observes all positions, then all velocities, unscaled."""
    quantities: tuple[Quantity, ...] = ("position", "velocity")
    terms = [ObservationTerm(q, name, 1.0) for q in quantities for name in description.joint_names]
    return PolicySpec.of_robot(description, terms, (0.25,) * len(description.actuated))


class LinearPolicy:
    """Action = gains x observation, for one actuated joint.

    Args:
        spec: Its observations and action.
        gains: Target per observed quantity, (O,) [m or rad per unit].
        disturb: Called with the number of the call, from 0, and the action; returns the action to use.
    """

    def __init__(
        self,
        spec: PolicySpec,
        gains: Sequence[float] = CARTPOLE_GAINS,
        disturb: Callable[[int, FloatArray], FloatArray] = lambda call, action: action,
    ) -> None:
        self.spec = spec
        self.calls = 0
        self._gains = np.array(gains) / spec.action_scale[0]
        self._disturb = disturb

    def reset(self) -> None:
        """Restart the count of calls."""
        self.calls = 0

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (1,)."""
        action = np.array([float(np.dot(self._gains, observation))])
        self.calls += 1
        return self._disturb(self.calls - 1, action)
