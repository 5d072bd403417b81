"""Turning an arm's joints by hand: which servo moves, in which direction, and how far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from deal_hw.drivers.servo_arm.families import OFF
from deal_hw.drivers.servo_arm.survey import Survey
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import TICKS
from deal_hw.workflows.own_robot.dialogue import Dialogue

_PERIOD_NS: Final = 20_000_000
_TRIES: Final = 3
LEAST_TRAVEL: Final = 100
"""A joint that was turned less is asked for again [ticks]: 9 degrees."""
_MOST_BESIDE: Final = 0.5
"""If another servo moved more than this share of the one that moved most, it is unclear which was meant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Turned:
    """A joint that was turned from its positive to its negative end.

    Attributes:
        servo: The servo that moved.
        direction: 1 if its position was higher at the positive end, else -1.
        low: Lowest position [ticks]; not wrapped around at the end of a turn, so it may be below 0.
        high: Highest one [ticks]; may be above those of a turn.
    """

    servo: int
    direction: Literal[1, -1]
    low: int
    high: int


class _Track:
    """Positions of servos over the end of a turn [ticks]."""

    def __init__(self, ticks: dict[int, int]) -> None:
        self._raw = dict(ticks)
        self.now, self.low, self.high = dict(ticks), dict(ticks), dict(ticks)

    def see(self, ticks: dict[int, int]) -> None:
        for servo, at in ticks.items():
            step = (at - self._raw[servo] + TICKS // 2) % TICKS - TICKS // 2
            self._raw[servo] = at
            self.now[servo] += step
            self.low[servo] = min(self.low[servo], self.now[servo])
            self.high[servo] = max(self.high[servo], self.now[servo])

    def moved(self, servo: int) -> int:
        """Return how far a servo was turned, both ways [ticks]."""
        return self.high[servo] - self.low[servo]


class Hands:
    """A person's hands at the arm, and what the servos measure meanwhile.

    Args:
        survey: The bus.
        servos: Ids of the servos.
        dialogue: Asks the person.
    """

    def __init__(self, survey: Survey, servos: Sequence[int], dialogue: Dialogue) -> None:
        self._survey, self._servos, self._dialogue = survey, tuple(servos), dialogue

    def free(self) -> None:
        """Switch the torque off after a question, if a servo has any.

        Raises:
            ConfigurationError: The person does not want it.
        """
        stiff = [i for i, one in self._survey.samples(self._servos).items() if one.torque != OFF]
        if not stiff:
            return
        answer = self._dialogue.ask(
            f"Servos {', '.join(map(str, stiff))} hold the arm. To turn it by hand the torque must be off: "
            "THE ARM FALLS. Hold it, or lay it down. Switch the torque off?",
            ("y", "n"),
        )
        if answer != "y":
            raise ConfigurationError(
                "the torque stays on, nothing was changed; without it the joints cannot be turned"
            )
        self._survey.release(self._servos)

    def turn(self, joint: str, positive: str, taken: Sequence[tuple[int, str]] = ()) -> Turned:
        """Let a joint be turned to both of its ends.

        Args:
            joint: The joint.
            positive: Which way is positive, in words.
            taken: Servos of other joints, which must not move most.

        Raises:
            ConfigurationError: It stayed unclear which servo is this joint's.
            TransportTimeoutError: The servos fell silent.
        """
        owners, problem = dict(taken), ""
        for _ in range(_TRIES):
            self._dialogue.say(f"\nJoint {joint}: {positive}")
            track = _Track(self._ticks())
            self._watch(track, f"Turn {joint} to its POSITIVE end, and hold it there.")
            up = dict(track.now)
            self._watch(track, f"Now turn {joint} to its NEGATIVE end.")
            down = dict(track.now)
            first, *rest = sorted(self._servos, key=track.moved, reverse=True)
            beside = [i for i in rest if track.moved(i) > _MOST_BESIDE * track.moved(first)]
            problem = ""
            if track.moved(first) < LEAST_TRAVEL:
                problem = f"no servo moved by more than {track.moved(first)} ticks"
            elif beside:
                named = ", ".join(map(str, (first, *beside)))
                problem = f"servos {named} moved alike: hold the other joints still"
            elif first in owners:
                problem = f"servo {first} moved, which is that of {owners[first]}"
            elif 2 * abs(up[first] - down[first]) < track.moved(first):
                problem = "its two ends are not the ends of its travel: turn it from one to the other, once"
            if not problem:
                return Turned(
                    servo=first,
                    direction=1 if up[first] > down[first] else -1,
                    low=track.low[first],
                    high=track.high[first],
                )
            self._dialogue.say(f"{joint}: {problem}. Once more.")
        raise ConfigurationError(f"joint {joint}: {problem}; asked {_TRIES} times, nothing was written")

    def pose(self, text: str) -> dict[int, int]:
        """Let the arm be put into a pose; return the servos' positions there [ticks]."""
        track = _Track(self._ticks())
        self._watch(track, text)
        return self._ticks()

    def _watch(self, track: _Track, text: str) -> None:
        clock = self._survey.clock
        self._dialogue.begin(text)
        while True:
            # Asked before the sample, so that the newest position is one after the answer.
            done = self._dialogue.done()
            track.see(self._ticks())
            if done:
                return
            clock.sleep_until_ns(clock.now_ns() + _PERIOD_NS)

    def _ticks(self) -> dict[int, int]:
        return {i: one.ticks for i, one in self._survey.samples(self._servos).items()}
