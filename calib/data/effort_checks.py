"""Recorded efforts against the model's, before any long work: their sign and their unit."""

from __future__ import annotations

import numpy as np

from deal_hw.calib.data.parts import longest_windows
from deal_hw.calib.data.problem import Problem
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

WINDOW_S = 0.2
TURNED = -0.5
"""A correlation with the model's torque below this is that of another direction."""

OTHER_UNIT = 5.0
"""A recorded effort that is larger or smaller than the model's by more than this factor has another unit."""

ALIKE = 0.5
"""Least correlation at which the size is compared: below, the model may be wrong, but no unit is."""


def check_efforts(problem: Problem) -> None:
    """Compare the sign and size of recorded efforts with those of the nominal model.

    Raises:
        ConfigurationError: An effort has the other sign, or looks like a percentage or a current.
        InsufficientDataError: The recordings have no efforts, or hold no window.
    """
    if not problem.efforts:
        return
    count, joints = len(problem.efforts), problem.robot.description.joint_names
    measured: list[FloatArray] = []
    predicted: list[FloatArray] = []
    latency_s = np.array([problem.first_latency_s])
    for data in longest_windows(problem, WINDOW_S):
        observed = problem.predict(problem.space.nominal[None], latency_s, data).observed[0]
        seen = np.isfinite(data.std[..., -count:]).all(axis=-1) & np.isfinite(observed).all(axis=-1)
        measured.append(data.measured[..., -count:][seen])
        predicted.append(observed[..., -count:][seen])
    real, model = np.concatenate(measured), np.concatenate(predicted)
    gains = {e: p.nominal for p in problem.space.parameters if p.kind == "effort_gain" for e in p.elements}
    for column, index in enumerate(problem.efforts):
        name = joints[index]
        x, y = model[:, column] - model[:, column].mean(), real[:, column] - real[:, column].mean()
        spread = float(x @ x)
        if not (spread > 0 and float(y @ y) > 0):
            raise ConfigurationError(
                f"the effort of {name!r} never changes in these recordings or in the model; remove its "
                "effort_gain, effort_bias and effort_delay"
            )
        correlation, gain = float(x @ y) / np.sqrt(spread * float(y @ y)), gains.get(name, 1.0)
        factor = float(np.sqrt(float(y @ y) / spread))
        if correlation < TURNED:
            raise ConfigurationError(
                f"the recorded effort of {name!r} has the other sign than the model's torque (correlation "
                f"{correlation:.2f}); multiply its column by -1. `sign` in the column map turns position and "
                "effort together"
            )
        if correlation > ALIKE and not 1 / OTHER_UNIT < factor < OTHER_UNIT:
            raise ConfigurationError(
                f"the recorded effort of {name!r} is {factor * gain:.3g} times the model's torque, so it is "
                "no torque in N·m (or force in N): percent of the full torque, or a current? Multiply "
                "percent by the full torque over 100, or write what one N·m is in the recording: {kind: "
                f"effort_gain, elements: {name}, nominal: {factor * gain:.3g}}}"
            )
