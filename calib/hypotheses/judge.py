"""The one judge: what each hypothesis predicts of motion that its fit did not see, among all that were asked.

A hypothesis is fitted to one part of the recordings and predicts another one, beside the model without it,
which has seen at least as much. The ratio of their likelihoods there is an e-value: where the model is right
without the hypothesis, it is at most 1 on average, for any model and any number of samples (Wasserman, Ramdas
and Balakrishnan 2020). E-values bound the false discoveries among all that were asked, however they depend on
each other (Wang and Ramdas 2022); laws do, as most explain a part of what another one does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from deal_hw.calib.hypotheses.thresholds import EVIDENCE, FALSE_DISCOVERIES, NOTICED, TEMPER

Asked = TypeVar("Asked")


@dataclass(frozen=True, slots=True)
class UnseenGain:
    """What a hypothesis gains on motion that its fit did not see.

    Attributes:
        before: Mean squared residual without it [noise variances, or any other unit].
        after: The same with it.
        count: Number of independent residuals: their number over their correlation time.
    """

    before: float
    after: float
    count: float

    @property
    def share(self) -> float:
        """Share of the squared residual that it explains [-]; below 0 where it predicts worse."""
        return 1 - self.after / self.before

    @property
    def deviance(self) -> float:
        """Gain in deviance, twice the logarithm of the likelihood ratio; the noise level is estimated [-]."""
        return self.count * float(np.log(self.before / self.after))

    def promises(self, asked: int) -> bool:
        """Return whether a judge who asks so many hypotheses may accept it, if it accepts all others."""
        return self.share > NOTICED and self.deviance >= needed(asked, asked)


def needed(asked: int, number: int = 1) -> float:
    """Return the least gain in deviance of the ``number``-th best of so many hypotheses, to accept it [-].

    The ``number`` best are accepted where the e-value of the last one is at least ``asked`` / (``number``
    :data:`FALSE_DISCOVERIES`). It is the likelihood ratio to a power of :data:`TEMPER`.
    """
    return 2.0 / TEMPER * float(np.log(max(asked, number) / (number * FALSE_DISCOVERIES)))


def accepted(gains: Mapping[Asked, UnseenGain | None], asked: int | None = None) -> list[Asked]:
    """Return the hypotheses that predict better than the model without them, best first.

    Args:
        gains: What each gains; None where it was not fitted, or predicts no better.
        asked: How many were asked, also in other ways; these by default.
    """
    every = max(asked or 0, len(gains))
    some = {each: gain for each, gain in gains.items() if gain is not None and gain.promises(every)}
    order = sorted(some, key=lambda each: -some[each].deviance)
    enough = [k for k, each in enumerate(order, 1) if some[each].deviance >= needed(every, k)]
    return order[: max(enough, default=0)]


def alike(best: float, other: float) -> bool:
    """Return whether no more than chance tells the deviances of two hypotheses apart."""
    return best - other < EVIDENCE
