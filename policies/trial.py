"""Tests a policy before it may move a robot: its network runs in a separate process, which can be killed.

A policy file may come from anywhere. Its network may loop for ever, crash the process that loads it, use all
memory, or answer with NaN. So the process that supervises the robot never opens the file. It gets the spec
from another process, tests the network there on observations of this robot, and stores the file's digest. By
the digest the control process later knows that it opens the same bytes.
"""

from __future__ import annotations

import contextlib
import importlib.util
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
from typing_extensions import Self

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.description import RobotDescription
from deal_hw.errors import MissingExtraError, PolicyError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.policies.separate_process import SeparateProcess
from deal_hw.policies.trial_states import GivenVelocity, Probe, ProbeStates
from deal_hw.policy import Observation, PolicySpec
from deal_hw.types import FloatArray

_REPEATS: Final = 3
"""Repetitions of the timing of a late action."""


MEMORY_BYTES: Final = 2**30
"""Memory for loading and running, beyond what onnxruntime itself uses."""
SEED: Final = 0
"""Seeds the random observations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialSettings:
    """Limits and size of a trial.

    Attributes:
        processor_s: Processor time for loading and all observations together, whole seconds [s]; 0.1 s is
            usual. A busy computer does not use it up.
        time_limit_s: Time for start, loading and all observations together [s]; 0.5 s is usual.
        nominal: Observations of the robot at rest in its default pose.
        random: Random observations, within the ranges of the description.
    """

    processor_s: int = 10
    time_limit_s: float = 60.0
    nominal: int = 20
    random: int = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialReport:
    """Result of a trial.

    Attributes:
        spec: The policy's spec.
        digest: SHA-256 of the file's bytes, in hexadecimal.
        observations: Number of observations.
        median_s: Median processor time of an action, by kind of state [s].
    """

    spec: PolicySpec
    digest: str
    observations: int
    median_s: dict[str, float]


class TrialPolicy:
    """A policy whose network runs in a separate process; a context manager.

    Args:
        path: The file.
        settings: Its limits.
        clock: For the time limit; the machine's monotonic clock by default.

    Attributes:
        path: The file.
        seconds: Processor time of the network's last answer [s].
        observations: Single observations so far, each (O,).
    """

    def __init__(
        self, path: Path, settings: TrialSettings = TrialSettings(), clock: Clock | None = None
    ) -> None:
        self.path = path
        self.seconds = 0.0
        self.observations: list[Observation] = []
        self._settings, self._clock = settings, clock or MonotonicClock()
        self._facts: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Start the process and read the spec from it.

        Raises:
            MissingExtraError: onnxruntime is not installed.
            PolicyError: The file holds no policy that can be loaded.
        """
        _require_onnxruntime()
        settings = self._settings
        self._process = SeparateProcess(
            "deal_hw.policies.trial_process",
            [str(self.path)],
            source=self.path,
            does="loading and trying the network",
            memory_bytes=MEMORY_BYTES,
            processor_s=settings.processor_s,
            time_limit_s=settings.time_limit_s,
            clock=self._clock,
        )
        try:
            self._facts = self._process.ask()
            self._spec = PolicySpec.from_json(self._facts["spec"])
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *args: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill the process."""
        self._process.close()

    @property
    def process_id(self) -> int:
        """Id of the process that runs the network."""
        return self._process.process_id

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        return self._spec

    @property
    def digest(self) -> str:
        """SHA-256 of the file's bytes, in hexadecimal."""
        return str(self._facts["digest"])

    @property
    def takes_batches(self) -> bool:
        """Whether the network takes more than one observation at a time."""
        return bool(self._facts["batches"])

    def reset(self) -> None:
        """Clear the memory of a recurrent network; of others the observation carries the past.

        Raises:
            PolicyError: The process ended.
        """
        if self._spec.recurrent:
            self._process.ask([])

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,).

        Raises:
            PolicyError: The observation is not finite, or as :meth:`act_batch`.
        """
        for i in np.flatnonzero(~np.isfinite(observation)):
            term = self._spec.observation[i]
            raise PolicyError(
                f"{self.path}: field observation[{i}] ({term.quantity} of {term.joint!r}, scale "
                f"{term.scale:g}) is {observation[i]} in a state that this robot can reach; allowed: finite "
                "numbers; correct its scale"
            )
        self.observations.append(observation)
        action: FloatArray = self.act_batch(observation[None])[0]
        return action

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O).

        Raises:
            PolicyError: The network fails, its answer is not finite, or it comes too late.
        """
        reply = self._process.ask(observations.tolist())
        actions: FloatArray = np.array(reply["actions"], dtype=float)
        self.seconds = float(reply["seconds"])
        for row, i in np.argwhere(~np.isfinite(actions)):
            raise PolicyError(
                f"{self.path}: the network answers {actions[row, i]} for {self._spec.actuated[i]!r}; "
                "allowed: finite actions; train it again or give another policy"
            )
        return actions


def _require_onnxruntime() -> None:
    """Look for it without loading it: the process that runs the network could only crash without it."""
    with contextlib.suppress(ImportError, ValueError):
        if importlib.util.find_spec("onnxruntime") is not None:
            return
    raise MissingExtraError("onnxruntime", "deploy")


def check_policy(
    path: Path, description: RobotDescription, settings: TrialSettings = TrialSettings()
) -> TrialReport:
    """Check a policy file completely, with :class:`TrialPolicy` and :func:`try_policy`.

    Raises:
        PolicyError: It must not run on this robot; the message says why in one line.
    """
    with TrialPolicy(path, settings) as policy:
        return try_policy(policy, description, settings)


def try_policy(
    policy: TrialPolicy, description: RobotDescription, settings: TrialSettings = TrialSettings()
) -> TrialReport:
    """Run a policy on nominal, extreme and random states of a robot, with the code that runs it later.

    Raises:
        PolicyMismatchError: It was made for another robot, or observes what this one cannot measure.
        PolicyError: It fails, its answer is not finite, or it takes longer than the robot allows.
    """
    source = GivenVelocity()
    behaviour = PolicyBehaviour(policy, description, source)
    states = ProbeStates(description)
    rng = np.random.default_rng(SEED)
    times: dict[str, list[float]] = {}
    for probe in (*states.nominal(settings.nominal), *states.extreme(), *states.random(settings.random, rng)):
        if probe.fresh:
            behaviour.reset()
        source.wanted = probe.velocity
        try:
            took_s = _try(policy, behaviour, probe, description.limits.action_age_s)
        except PolicyError as err:
            raise PolicyError(f"{err} (seen with {probe.name})") from err
        times.setdefault(probe.kind, []).append(took_s)
    observations = np.stack(policy.observations)
    if policy.takes_batches:
        policy.act_batch(observations)
    return TrialReport(
        spec=policy.spec,
        digest=policy.digest,
        observations=len(observations),
        median_s={kind: median(taken) for kind, taken in times.items()},
    )


def _try(policy: TrialPolicy, behaviour: PolicyBehaviour, probe: Probe, allowed_s: float) -> float:
    """Return a policy's time from a state to a command [s]."""
    times = [_time_command(policy, behaviour, probe)]
    while times[0] > allowed_s and len(times) < _REPEATS:
        # One late action may have another cause, such as cold caches, so only the median counts.
        times.append(_time_command(policy, behaviour, probe))
    if median(times) > allowed_s:
        raise PolicyError(
            f"{policy.path}: an action takes {1e3 * median(times):.1f} ms (median of {len(times)}), robot "
            f"{policy.spec.robot!r} allows {1e3 * allowed_s:g} ms (limits.action_age_s); give a smaller "
            "network or a faster computer"
        )
    return times[0]


def _time_command(policy: TrialPolicy, behaviour: PolicyBehaviour, probe: Probe) -> float:
    """Return the processor time of a command, here and in the network's process [s].

    The time of other programs does not count: the control process has priority over them.
    """
    begun = time.thread_time()
    # act() finds and names values that are too large for the network's numbers.
    with np.errstate(all="ignore"):
        behaviour.command(probe.state, 0.0)
    return time.thread_time() - begun + policy.seconds
