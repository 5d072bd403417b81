"""Parameters in a model that other code simulates, such as a user's Gymnasium environment."""

from __future__ import annotations

import copy
from typing import Any

import mujoco

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import KINDS, apply_parameters, check_space
from deal_hw.sim.parameters.fields import ModelFields
from deal_hw.types import FloatArray


class ModelInPlace:
    """Writes parameters into a model, each time from its first values.

    Args:
        model: An MjModel; its present values are nominal.
        space: The parameters.

    Raises:
        ConfigurationError: A parameter acts outside the model, such as an encoder's bias.
        UnknownNameError: The model lacks an element.
    """

    def __init__(self, model: Any, space: ParameterSpace) -> None:
        outside = [p.name for p in space.parameters if p.kind not in KINDS]
        if outside:
            raise ConfigurationError(
                f"parameters {', '.join(outside)} act on commands and measurements, not in the model of an "
                "environment; calibrate without them (--parameters), or train with --nominal"
            )
        check_space(model, space)
        self._model, self._space = model, space
        self._fields = ModelFields(model, copy.copy(model))

    def apply(self, theta: FloatArray) -> None:
        """Write free parameters, (K,), and the known ones; simulation states stay."""
        apply_parameters(self._fields, self._space, theta[None])
        # Derives constants that depend on masses; the environment's own data stay.
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))
