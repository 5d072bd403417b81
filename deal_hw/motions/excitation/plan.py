"""A planned excitation for calibration, as a small JSON file, and its behaviour.

The optimum is computed before the run; the control process only reads the table and plays it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, UnknownNameError, shown
from deal_hw.motions.behaviours import Behaviour, centre, position_command
from deal_hw.motions.excitation.behaviours import Segment, segment_command
from deal_hw.motions.excitation.centring import Centring
from deal_hw.motions.excitation.limits import fit_to_limits, largest_factor, room
from deal_hw.motions.excitation.waveforms import (
    Arrangement,
    Law,
    Sweep,
    Wave,
    ease,
    multisine,
    random_steps,
)
from deal_hw.reading import read_json, reading
from deal_hw.schema import FINITE, from_values
from deal_hw.types import FloatArray, JointCommand, RobotState

FORMAT = "deal_hw.excitation/1"
MAX_SECONDS = 86_400.0
"""Longest run that a plan may describe [s]."""
_CHECKED = 1000
"""Number of times of a run at which a signal is checked before it is played."""
Family = Literal["multisine", "chirp", "steps"]
FAMILIES = get_args(Family)
OF_FAMILY: Mapping[Family, tuple[str, ...]] = MappingProxyType(
    {"multisine": ("low_hz", "high_hz", "seed"), "chirp": ("low_hz", "high_hz"), "steps": ("seed",)}
)
"""Design fields that only some families have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExcitationDesign:
    """A few numbers from which a plan is made; an optimiser varies them."""

    family: Family = "multisine"
    """multisine: sum of sines with a low peak; chirp: a sweep; steps: random set-points."""
    seconds: float = 4.0
    """Length of the run [s]."""
    amplitude: float = 1.0
    """Amplitude, as a share of the largest one within the limits, up to 1."""
    low_hz: float = 0.3
    """Lowest frequency of multisine and chirp [Hz]."""
    high_hz: float = 5.0
    """Highest frequency of multisine and chirp [Hz]."""
    tilt: float = 0.5
    """How the amplitudes of a multisine fall with frequency: 0 flat, 1 equal speeds."""
    law: Law = "linear"
    """How a chirp's frequency grows."""
    arrangement: Arrangement = "one-by-one"
    """How a chirp treats several joints."""
    hold_s: tuple[float, float] = (0.1, 0.3)
    """Shortest and longest hold of a step [s]."""
    balance_s: float = 0.0
    """Time of balancing with a policy at the start [s]; 0 for robots that stand by themselves."""
    ease_s: float = 0.2
    """Time of fading in from the first set-point, and of fading out at the end [s]; not for steps."""
    split: float = 0.5
    """Fraction of the run after which the second factors hold."""
    effort: tuple[float, float] = (1.0, 1.0)
    """Factor on the commanded effort limit, before and after the split."""
    speed: tuple[float, float] = (1.0, 1.0)
    """Factor on the commanded speed limit, before and after the split."""
    seed: int = 0
    """Seed of the signal's random numbers."""

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise UnknownNameError("excitation", self.family, FAMILIES)
        if not (0 < self.amplitude <= 1 and 0 <= self.balance_s < self.seconds and 0 < self.split <= 1):
            raise ConfigurationError(
                f"not a usable excitation: amplitude {self.amplitude:g} (a share of the largest amplitude; "
                f"allowed: above 0, up to 1), balance_s {self.balance_s:g} of {self.seconds:g} s, split "
                f"{self.split:g} (allowed: above 0, up to 1)"
            )

    def segments(self) -> tuple[Segment, ...]:
        """Return the parts of the run with other commanded limits; empty if all factors are 1."""
        bounds = [(0.0, self.split), (self.split, 1.0)] if self.split < 1 else [(0.0, 1.0)]
        parts = [
            Segment(start=low, stop=high, effort_limit=effort, speed_limit=speed)
            for (low, high), effort, speed in zip(bounds, self.effort, self.speed, strict=False)
        ]
        return tuple(p for p in parts if p.effort_limit != 1.0 or p.speed_limit != 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExcitationPlan:
    """What is played.

    Attributes:
        robot: Name of the robot.
        digest: Digest of the robot's description.
        seconds: Length of the run [s].
        balance_s: Time of balancing with a policy at the start [s].
        ease_s: Time of fading in, and of fading out [s].
        wave: Offsets from the robot's centre, after the balancing.
        segments: Parts of the run with other commanded gains and limits.
        words: One line that describes the plan.
        predicted: Predicted standard deviation of each parameter in its own scale, if computed.

    Raises:
        ConfigurationError: The times do not fit together.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    robot: str
    digest: str
    seconds: float
    balance_s: float
    ease_s: float
    wave: Wave
    segments: tuple[Segment, ...] = ()
    words: str = ""
    predicted: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (0 <= self.balance_s < self.seconds <= MAX_SECONDS and 0 <= self.ease_s <= self.seconds):
            raise ConfigurationError(
                f"an excitation of {self.seconds:g} s, with {self.balance_s:g} s of balancing and fades of "
                f"{self.ease_s:g} s; allowed: up to {MAX_SECONDS:g} s, which include balancing and fades"
            )

    def check_fits(self, description: RobotDescription) -> None:
        """Check that the plan was made for this robot.

        Raises:
            ConfigurationError: It was made for another robot, or its signal is not one finite number for each
                actuated joint.
        """
        if self.robot != description.name or self.digest != description.digest():
            raise ConfigurationError(
                f"the excitation was made for robot {shown(self.robot)} (description "
                f"{shown(self.digest)}), but this is {description.name!r} ({description.digest()}); make a "
                "new one with `deal-hw design-excitation`"
            )
        with np.errstate(all="ignore"):
            offsets = self.offsets(np.linspace(0.0, self.seconds, _CHECKED))
        if offsets.shape[1] != len(description.actuated) or not np.isfinite(offsets).all():
            raise ConfigurationError(
                f"the excitation has offsets for {offsets.shape[1]} joints, or offsets that are not "
                f"finite; needed: finite offsets of the {len(description.actuated)} actuated joints of "
                f"{description.name!r}; make a new one with `deal-hw design-excitation`"
            )

    def offsets(self, time_s: FloatArray) -> FloatArray:
        """Return the signal with its fades at times of the run, (T,) -> (T, A); 0 while balancing."""
        local = time_s - self.balance_s
        window = ease(local, self.seconds - self.balance_s, self.ease_s)
        return np.asarray(self.wave.at(local) * window[:, None])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {"format": FORMAT, **dataclasses.asdict(self)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ExcitationPlan:
        """Return the plan that :meth:`to_json` wrote.

        Raises:
            ConfigurationError: The values are not those of a plan.
        """
        given = dict(values)
        if (found := given.pop("format", None)) != FORMAT:
            raise ConfigurationError(f"not an excitation: format is {shown(found)}, not {FORMAT!r}")
        try:
            return from_values(cls, given)
        except ConfigurationError as err:
            raise ConfigurationError(f"not an excitation: {err}") from err

    def write(self, path: Path) -> None:
        """Write the plan as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.to_json(), indent=1) + "\n", encoding="utf-8")


def read_plan(path: Path) -> ExcitationPlan:
    """Return the plan of a file.

    Raises:
        ConfigurationError: It cannot be read, or contains no plan.
    """
    advice = f"--excite takes {', '.join(FAMILIES[:2])}, or a file that `deal-hw design-excitation` wrote"
    values = read_json(path, dict[str, Any], "an excitation", advice, error=ConfigurationError)
    with reading(path, "an excitation"):
        return ExcitationPlan.from_json(values)


def make_plan(description: RobotDescription, design: ExcitationDesign) -> ExcitationPlan:
    """Return the plan of a design, with the design's amplitude within the safety limits.

    Raises:
        ConfigurationError: No joint has room to move, or a factor is too large.
    """
    _check_factors(description, design)
    rng = np.random.default_rng(design.seed)
    length = design.seconds - design.balance_s
    most = room(description)
    wave: Wave
    ease_s = min(design.ease_s, 0.25 * length)
    if design.family == "steps":
        wave, ease_s = random_steps(most, length, design.hold_s, rng), 0.0
    elif design.family == "chirp":
        wave = Sweep(
            amplitude=tuple(map(float, most)),
            duration_s=length,
            low_hz=design.low_hz,
            high_hz=design.high_hz,
            law=design.law,
            arrangement=design.arrangement,
        )
    else:
        wave = multisine(most, design.low_hz, design.high_hz, 1.0 / length, tilt=design.tilt, rng=rng)
    plan = ExcitationPlan(
        robot=description.name,
        digest=description.digest(),
        seconds=design.seconds,
        balance_s=design.balance_s,
        ease_s=ease_s,
        wave=wave,
        segments=design.segments(),
        words=describe_design(design),
    )
    times = design.balance_s + np.arange(0.0, length, 1.0 / description.control_rate_hz)
    scale = fit_to_limits(description, plan.offsets(times), smooth=design.family != "steps")
    return dataclasses.replace(plan, wave=wave.scaled(scale * design.amplitude))


def _check_factors(description: RobotDescription, design: ExcitationDesign) -> None:
    limits = description.limits
    for what, factors, default, most in (
        ("effort", design.effort, description.effort_limit, limits.effort),
        ("speed", design.speed, description.speed_limit, limits.speed),
    ):
        for factor in factors:
            # The description's own defaults are always allowed.
            if factor != 1.0 and not 0 < factor <= largest_factor(default, most):
                greatest = largest_factor(default, most)
                raise ConfigurationError(
                    f"{what} factor {factor:g} on robot {description.name!r}: allowed is above 0 and up to "
                    f"{greatest:.3g}; the safety filter would clip more"
                )


def describe_design(design: ExcitationDesign) -> str:
    """Return a design as text, for the advice and the file."""
    band = f"{design.low_hz:.2g} to {design.high_hz:.2g} Hz"
    what = {
        "multisine": f"a multisine of {band}",
        "chirp": f"a {design.law} chirp of {band}",
        "steps": f"random set-points held {design.hold_s[0]:.2g} to {design.hold_s[1]:.2g} s",
    }[design.family]
    parts = [f"{design.seconds:g} s of {what} at {design.amplitude:.0%} of the largest amplitude"]
    if design.balance_s:
        parts.append(f"{design.balance_s:.2g} s of balancing first")
    for part in design.segments():
        sent = [
            f"{factor:.2g} times the {name} limit"
            for name, factor in (("effort", part.effort_limit), ("speed", part.speed_limit))
            if factor != 1.0
        ]
        whole = part.start == 0.0 and part.stop == 1.0
        when = "all the time" if whole else f"from {part.start:.0%} to {part.stop:.0%} of the run"
        parts.append(f"{' and '.join(sent)} {when}")
    return ", ".join(parts)


class ExcitationBehaviour:
    """Balances if the plan requires it, then plays its signal around the robot's centre.

    The signal fades in from the last set-point of the balancing, so it starts without a jump.

    Args:
        plan: The plan.
        description: The robot.
        balance: The balancing behaviour; needed if the plan balances first.

    Raises:
        ConfigurationError: The plan is for another robot, or the balancing behaviour is missing.
    """

    def __init__(
        self, plan: ExcitationPlan, description: RobotDescription, balance: Behaviour | None = None
    ) -> None:
        plan.check_fits(description)
        if plan.balance_s > 0 and balance is None:
            raise ConfigurationError(
                f"the excitation balances for {plan.balance_s:g} s first, but there is no policy; give "
                "--policy FILE"
            )
        self._plan, self._description = plan, description
        self._balance = balance if plan.balance_s > 0 else None
        self._centre, self._centring = centre(description), Centring(description)
        self.action: FloatArray | None = None
        self.reset()

    def reset(self) -> None:
        """Restart with the same signal."""
        self._last = self._centre
        self.action = None
        if self._balance is not None:
            self._balance.reset()

    def command(self, state: RobotState, time_s: float) -> JointCommand:
        """Return the balancing command or the signal's set-point, with the segment's limits."""
        # Half a millisecond of slack: times are multiples of the control period, not exact in binary.
        if self._balance is not None and time_s + 5e-4 < self._plan.balance_s:
            wanted = self._balance.command(state, time_s)
            self.action, self._last = self._balance.action, wanted.position_target
            return self._scaled(wanted, time_s)
        self.action = None
        offset = self._plan.offsets(np.array([max(time_s, self._plan.balance_s)]))[0]
        target = self._centre + offset + self._left(time_s) * (self._last - self._centre)
        target = self._centring.added(target, state)
        return self._scaled(position_command(self._description, target), time_s)

    def _left(self, time_s: float) -> float:
        """Return the remaining share of the balancing's last set-point at a time."""
        if self._plan.ease_s <= 0:
            return 0.0
        since = max(time_s - self._plan.balance_s, 0.0)
        return 1.0 - float(ease(np.array([since]), float("inf"), self._plan.ease_s)[0])

    def _scaled(self, command: JointCommand, time_s: float) -> JointCommand:
        return segment_command(command, self._plan.segments, time_s / self._plan.seconds)
