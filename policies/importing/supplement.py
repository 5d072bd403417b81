"""What the operator says where an exported file says nothing: each answer by the option that gives it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeVar

from deal_hw.errors import ConfigurationError, shown
from deal_hw.policies.importing.manifest import check_history
from deal_hw.ranges import option
from deal_hw.schema import either

T = TypeVar("T")
AtRest = Literal["runs", "zero"]

REST: Final = 0.1
"""Length of a command below which a clock that stands at rest reads zero, as in unitree_rl_mjlab."""
AXES_NAMED: Final = ("x", "y", "yaw")


@dataclass(frozen=True, slots=True, kw_only=True)
class Supplement:
    """Answers; those that were used are noted.

    Attributes:
        joints: The policy's joints in its own order, by the robot's names.
        motors: The robot's joints by the vendor's motor numbers.
        observations: Terms of the observation in order.
        control_rate: Control rate [Hz].
        observation_scales: Factors: one number for all terms, or ``term=number`` with commas between; those
            not named are 1.
        history: Values of each term, the present one included, in the same form.
        command_range: Velocity commands, ``low:high`` for x, y [m/s] and yaw [rad/s] with commas between.
        clock: Turns per second of the observed clock [Hz].
        clock_at_rest: Whether the clock runs on, or reads zero, while the command is to stand.
        observation_clip: Largest absolute value of each entry before its factor.
    """

    joints: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    observations: tuple[str, ...] = ()
    control_rate: float | None = None
    observation_scales: str = ""
    history: str = ""
    command_range: str = ""
    clock: float | None = None
    clock_at_rest: AtRest | None = None
    observation_clip: float | None = None
    used: set[str] = field(default_factory=lambda: {"motors"})

    def get(self, name: str) -> Any:
        """Return an answer, or None; it counts as used."""
        self.used.add(name)
        value = getattr(self, name)
        return None if value in ("", ()) else value

    def need(self, name: str, why: str, example: str) -> Any:
        """Return an answer.

        Args:
            name: Its name.
            why: What the file does not say, as the beginning of a sentence.
            example: A possible answer.

        Raises:
            ConfigurationError: It was not given.
        """
        value = self.get(name)
        if value is None:
            raise ConfigurationError(f"{why}; give it as it was in training: {option(name)} {example}")
        return value

    def need_command_range(self, why: str) -> tuple[tuple[float, float], ...]:
        """Return the range of the velocity commands; errors as :meth:`need` and :func:`parse_range`."""
        return parse_range(self.need("command_range", why, "-1:1,-0.5:0.5,-1:1"))

    def refuse_unused(self, source: str) -> None:
        """Refuse answers to questions that a file answers itself.

        Raises:
            ConfigurationError: There is one.
        """
        given = [
            n for n in self.__dataclass_fields__ if n != "used" and getattr(self, n) not in ("", (), None)
        ]
        if spare := [option(name) for name in given if name not in self.used]:
            raise ConfigurationError(
                f"{', '.join(spare)}: {source} says that itself, or has nothing of the kind; leave "
                f"{'it' if len(spare) == 1 else 'them'} out, or correct the file"
            )


def parse_values(text: str, name: str, terms: Sequence[str], usual: float = 1.0) -> Mapping[str, float]:
    """Return a number for each term of ``0.2`` or of ``base_ang_vel=0.2,joint_vel=0.05``.

    Raises:
        ConfigurationError: The text is something else, or names an unknown term.
    """
    found = dict.fromkeys(terms, usual)
    if "=" not in text:
        return dict.fromkeys(terms, _number(text, name))
    for part in text.split(","):
        term, _, value = (word.strip() for word in part.partition("="))
        if term not in found:
            raise ConfigurationError(f"{name}: {shown(term)} is no term of the observation; {either(terms)}")
        found[term] = _number(value, name)
    return found


def parse_history(text: str, terms: Sequence[str]) -> Mapping[str, int]:
    """Return the number of values of each term; errors as :func:`parse_values`."""
    counts = parse_values(text, "--history", terms)
    for name, count in counts.items():
        if count != int(count):
            raise ConfigurationError(f"--history {shown(text)}: {count:g} is no whole number")
        check_history(name, int(count))
    return {name: int(count) for name, count in counts.items()}


def parse_range(text: str) -> tuple[tuple[float, float], ...]:
    """Return the pairs of ``-1:1,-0.5:0.5,-1:1``.

    Raises:
        ConfigurationError: The text is something else.
    """
    pairs = [part.split(":") for part in text.split(",")]
    if len(pairs) != len(AXES_NAMED) or not all(len(pair) == 2 for pair in pairs):
        raise ConfigurationError(
            f"--command-range {shown(text)}: allowed are three pairs low:high for x, y [m/s] and yaw "
            "[rad/s], such as -1:1,-0.5:0.5,-1:1"
        )
    found = []
    for axis, (low, high) in zip(AXES_NAMED, pairs, strict=True):
        ends = _number(low, "--command-range"), _number(high, "--command-range")
        if ends[0] > ends[1]:
            raise ConfigurationError(
                f"--command-range: {axis} goes from {low} down to {high}; low comes first"
            )
        found.append(ends)
    return tuple(found)


def _number(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    # Written so that NaN is refused, too.
    if not -1e9 <= value <= 1e9:
        raise ConfigurationError(f"{name}: {shown(text)} is no finite number")
    return value
