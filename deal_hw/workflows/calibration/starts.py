"""Where rollouts of a policy begin: in the recorded first state, or in states drawn from the recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np

from deal_hw.types import FloatArray
from deal_hw.workflows.say import Say

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem

SHOWN = 4
"""Most entries of the state that a sentence lists."""


def chosen_starts(
    problem: Problem, starts: Literal["recorded", "drawn"] | None, given: Mapping[str, float], say: Say
) -> FloatArray | None:
    """Return the spread of drawn start states (:attr:`Problem.start_std`); None for the recorded first state.

    Args:
        problem: Recordings of a policy, which is known.
        starts: What was asked for; None: drawn states where a first state is not known well, or where a
            spread is given.
        given: Standard deviation of entries of the state, by name.
        say: Called with a sentence where drawn states are chosen.

    Raises:
        UnknownNameError: A name is no entry of the state.
        InsufficientDataError: A recording is too short for a rollout.
    """
    from deal_hw.calib.data.start_states import given_std, uncertain_entries
    from deal_hw.calib.paper.rollouts import control_ticks, policy_of

    std = given_std(problem, given)
    if starts == "recorded":
        return None
    if starts == "drawn" or given:
        return std
    policy = policy_of(problem)
    ticks = [
        control_ticks(problem, index, 2, policy.history, ran_before=policy.ran_before)
        for index in range(len(problem.episodes))
    ]
    unknown = uncertain_entries(problem, [int(one.sample[0]) for one in ticks])
    if not unknown:
        return None
    worst = sorted(unknown, key=lambda name: -unknown[name])
    listed = ", ".join(f"{name} ({unknown[name]:.0%})" for name in worst[:SHOWN])
    more = "" if len(worst) <= SHOWN else f" and {len(worst) - SHOWN} more"
    say(
        f"the recordings do not show their first state well: {listed}{more} (uncertainty over the spread in "
        "the recording). So rollouts begin in states drawn from the whole recordings, each moved by its "
        "uncertainty; --starts recorded begins in the first state, --start-std NAME VALUE gives another one"
    )
    return np.asarray(std)
