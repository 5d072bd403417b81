"""Parameter kinds of sensors: they have no MuJoCo field.

A bias shifts what the simulator reports, a scale stretches it. Noise changes no prediction, so no search can
find it: a known value weights the recording, and without one the recording itself shows the noise.
"""

from __future__ import annotations

from deal_hw.sim.parameters.kind import Kind, one_dof_joint

ENCODER_BIAS = "encoder_bias"
"""Kind of parameter without a MuJoCo field: reported joint position at a true one of 0."""

ENCODER_SCALE = "encoder_scale"
"""Kind of parameter without a MuJoCo field: reported over true change of a joint position."""

SENSOR_KINDS = (
    Kind(
        name=ENCODER_BIAS,
        element="joint",
        quantity="encoder_bias",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="reported minus true joint position; a servo closes its loop on the reported one",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=one_dof_joint,
        scale="linear",
        spread=0.1,
        least=float("-inf"),
    ),
    Kind(
        name=ENCODER_SCALE,
        element="joint",
        quantity="encoder_scale",
        unit="-",
        writes=(),
        along="reported over true change of position; a servo closes its loop on the reported one",
        apply=None,
        baseline=lambda m, i: 1.0,
        usable=one_dof_joint,
        ratio=1.5,
    ),
    Kind(
        name="sensor_noise",
        element="joint",
        quantity="sensor_noise",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="standard deviation of white noise on the reported joint position; `known` only",
        apply=None,
        baseline=None,
        usable=one_dof_joint,
    ),
)
