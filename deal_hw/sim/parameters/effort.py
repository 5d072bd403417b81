"""Parameter kinds of a joint's effort sensor: reported = gain * torque(t - delay) + bias, plus noise.

They have no MuJoCo field. A joint with one of these parameters has its recorded effort compared with the
torque of its actuators in the model, which is the motor's before dry friction, damping and the rotor's
inertia (MuJoCo's qfrc_actuator). A gain in ampere per newton metre compares a current.
"""

from __future__ import annotations

from typing import Any

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.kind import Kind, joint_of, one_dof_joint

EFFORT_NOISE = "effort_noise"
"""The kind that weights the recorded efforts; no prediction depends on it."""


def _driven(model: Any, joint: int, name: str) -> None:
    one_dof_joint(model, joint, name)
    if not any(joint_of(model, actuator) == joint for actuator in range(model.nu)):
        joints = {joint_of(model, actuator) for actuator in range(model.nu)} - {-1}
        driven = sorted(model.joint(j).name for j in joints)
        raise ConfigurationError(
            f"no actuator drives joint {name!r}, so the model has no effort to compare with; driven are "
            f"{', '.join(driven) or '(none)'}"
        )


EFFORT_KINDS = (
    Kind(
        name="effort_gain",
        element="joint",
        quantity="effort_gain",
        unit="-",
        writes=(),
        along="recorded effort per newton metre of the motor, before friction and rotor inertia",
        apply=None,
        baseline=lambda m, i: 1.0,
        usable=_driven,
        ratio=1.3,
    ),
    Kind(
        name="effort_bias",
        element="joint",
        quantity="effort_bias",
        unit="N·m",
        unit_slide="N",
        writes=(),
        along="recorded effort of a motor without torque; in the recording's unit if that is a current",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_driven,
        scale="linear",
        spread=1.0,
        least=float("-inf"),
    ),
    Kind(
        name="effort_delay",
        element="joint",
        quantity="effort_delay",
        unit="s",
        writes=(),
        along="the recorded effort is older by it than the recorded position",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_driven,
        scale="linear",
        spread=0.01,
    ),
    Kind(
        name=EFFORT_NOISE,
        element="joint",
        quantity="effort_noise",
        unit="N·m",
        unit_slide="N",
        writes=(),
        along="standard deviation of white noise on the recorded effort; `known` only",
        apply=None,
        baseline=None,
        usable=_driven,
    ),
)
