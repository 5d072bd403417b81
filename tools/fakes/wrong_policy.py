"""A walking policy of a Go2 as it would be after a wrong import, by the error's name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import Observation, ObservationTerm, PolicySpec
from deal_hw.types import FloatArray

LEGS: Final = ("FL", "FR", "RL", "RR")
PARTS: Final = ("hip", "thigh", "calf")
Flipped = Callable[[ObservationTerm], bool]
Moved = Callable[[str], bool]


class WrongPolicy:
    """A policy with an error.

    Args:
        policy: The sound policy.
        joints: By a joint's name the one that it is taken for.
        flipped: Which entries of the observation have the wrong sign.
        moved: Which joints move the wrong way.
    """

    def __init__(
        self,
        policy: OnnxPolicy,
        joints: Mapping[str, str] | None = None,
        flipped: Flipped = lambda term: False,
        moved: Moved = lambda name: False,
    ) -> None:
        own, taken = policy.spec, dict(joints or {})
        terms = tuple(
            dataclasses.replace(term, joint=taken.get(term.joint, term.joint)) for term in own.observation
        )
        self._policy, self._spec = policy, dataclasses.replace(own, observation=terms)
        source = {taken.get(name, name): i for i, name in enumerate(own.actuated)}
        self._order = [source[name] for name in own.actuated]
        self._into = np.array([-1.0 if flipped(term) else 1.0 for term in own.observation])
        self._out = np.array([-1.0 if moved(name) else 1.0 for name in own.actuated])

    @property
    def spec(self) -> PolicySpec:
        """Its spec, with the wrong joints."""
        return self._spec

    def reset(self) -> None:
        """Clear the memory."""
        self._policy.reset()

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions."""
        asked = (observations * self._into).astype(np.float32)
        return np.asarray(self._policy.act_batch(asked)[:, self._order] * self._out)


def exchanged(*pairs: tuple[str, str]) -> dict[str, str]:
    """Return the joints of legs, each taken for that of the other leg of its pair."""
    names = [(f"{one}_{part}_joint", f"{other}_{part}_joint") for one, other in pairs for part in PARTS]
    return {a: b for pair in names for a, b in (pair, pair[::-1])}


def _of(quantity: str, *axes: str) -> Flipped:
    return lambda term: term.quantity == quantity and (not axes or term.joint in axes)


def _joint(*parts: str) -> tuple[Flipped, Moved]:
    """Return what flips joints whose names hold these parts, in observation and action."""

    def moved(name: str) -> bool:
        return all(part in name for part in parts)

    return (lambda term: moved(term.joint)), moved


ISAAC: Final = dict(
    zip(
        (f"{leg}_{part}_joint" for leg in LEGS for part in PARTS),
        (f"{leg}_{part}_joint" for part in PARTS for leg in LEGS),
        strict=True,
    )
)
_HIPS, _THIGH, _HIP = _joint("hip"), _joint("FL", "thigh"), _joint("FL", "hip")
ERRORS: Final[Mapping[str, Callable[[OnnxPolicy], WrongPolicy]]] = {
    "front legs exchanged": lambda p: WrongPolicy(p, exchanged(("FL", "FR"))),
    "rear legs exchanged": lambda p: WrongPolicy(p, exchanged(("RL", "RR"))),
    "left legs exchanged": lambda p: WrongPolicy(p, exchanged(("FL", "RL"))),
    "diagonal legs exchanged": lambda p: WrongPolicy(p, exchanged(("FL", "RR"))),
    "sides exchanged": lambda p: WrongPolicy(p, exchanged(("FL", "FR"), ("RL", "RR"))),
    "front and rear exchanged": lambda p: WrongPolicy(p, exchanged(("FL", "RL"), ("FR", "RR"))),
    "Isaac's order": lambda p: WrongPolicy(p, ISAAC),
    "actions": lambda p: WrongPolicy(p, moved=lambda name: True),
    "hips": lambda p: WrongPolicy(p, None, *_HIPS),
    "one hip": lambda p: WrongPolicy(p, None, *_HIP),
    "one thigh": lambda p: WrongPolicy(p, None, *_THIGH),
    "one hip's position": lambda p: WrongPolicy(p, flipped=_of("position", "FL_hip_joint")),
    "gravity": lambda p: WrongPolicy(p, flipped=_of("gravity")),
    "gravity's x and y": lambda p: WrongPolicy(p, flipped=_of("gravity", "x", "y")),
    "gyro": lambda p: WrongPolicy(p, flipped=_of("angular_velocity")),
    "yaw of the command": lambda p: WrongPolicy(p, flipped=_of("command", "z")),
    "positions": lambda p: WrongPolicy(p, flipped=_of("position")),
    "velocities": lambda p: WrongPolicy(p, flipped=_of("velocity")),
    "last actions": lambda p: WrongPolicy(p, flipped=_of("action")),
}
"""Exchanged joints, then wrong signs of what is named."""
