"""The alarm of residuals that a model does not explain: one, however many checks find them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.findings import Finding


@dataclass(frozen=True, slots=True)
class Unexplained(Finding):
    """The alarm of residuals that a model does not explain.

    Attributes:
        facts: What the residuals are, such as "3.0 times the sensor's noise".
        place: Sentences on why no known cause is named, and where they lie.
    """

    facts: tuple[str, ...] = ()
    place: str = ""

    @classmethod
    def of(cls, facts: Sequence[str], place: str = "") -> Unexplained:
        """Return the alarm."""
        if place:
            found = Finding.alarm(
                f"Residuals are {' and '.join(facts)}. {place.removesuffix('.')}.",
                "The model does not explain the recording: it lacks something that the robot has, or a "
                "sensor is wrong there: blind or bent in a part of its range, or with another scale. The "
                "intervals count all of it as noise.",
                "See in the report where on the motion they are largest, and check the sensor's scale "
                "against a known angle or length. Leave out what a sensor got wrong, or repair it; else add "
                "to the model what is missing. Judge this model by its held-out error.",
            )
        else:
            found = Finding.alarm(
                f"Residuals are {' and '.join(facts)}.",
                "The model does not explain the recording: it lacks something that the robot has (a friction "
                "law, backlash, a varying delay), or a range is too narrow. The intervals count all of it as "
                "noise.",
                "Repair the causes that other alarms name, or widen ranges, and calibrate again. Judge this "
                "model by its held-out error.",
            )
        return cls("unexplained", found.severity, found.seen, found.do, found.means, (), tuple(facts), place)

    @classmethod
    def larger(cls, chi2: float, window: str = "", place: str = "") -> Unexplained:
        """Return the alarm of residuals above the sensors' noise; ``window`` names the windows."""
        return cls.of([f"{np.sqrt(chi2):.1f} times the sensor's noise{window}"], place)


def autocorrelated(samples: float) -> str:
    """Return the fact of a residual that is autocorrelated over so many samples."""
    return f"autocorrelated over {samples:.1f} samples (the sensor's noise is not)"


def as_one(alarms: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return alarms with one of unexplained residuals at most, at the place of the first, with all facts.

    A fact that begins another one is left out: the longer one says more.
    """
    kept = list(alarms)
    ours = [alarm for alarm in kept if isinstance(alarm, Unexplained)]
    if len(ours) < 2:
        return tuple(kept)
    every = list(dict.fromkeys(itertools.chain.from_iterable(alarm.facts for alarm in ours)))
    facts = [fact for fact in every if not any(o != fact and o.startswith(fact) for o in every)]
    first = kept.index(ours[0])
    rest = [alarm for alarm in kept if not isinstance(alarm, Unexplained)]
    rest.insert(first, Unexplained.of(facts, next((alarm.place for alarm in ours if alarm.place), "")))
    return tuple(rest)
