"""The real Go2 with its base on a stand: targets at 50 Hz, states at 500 Hz, feet in the air.

The stand must hold the base level and still, because the model's base does not move. ``go2_suspended`` is
the 200 Hz recording of iit-DLSLab.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.descriptions import floor, on_stand_recording
from deal_hw.drivers.go2.descriptions.driver import DRIVER, driver_limits, legs_on_stand
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as FLOOR
from deal_hw.drivers.go2.descriptions.floor import STANDING_RAD, per_joint
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace

MOTOR_HZ: Final = 1000.0
LEAST_SHARE: Final = 0.1
"""Smallest share of the motor in the damping measured on the stand."""
WIDEST: Final = 10.0
"""Draws of a stand's result are kept if they lie within this factor of the model's own values."""
REACH_RAD: Final[Mapping[str, float]] = {"hip": 0.3, "thigh": 0.4, "calf": 0.5}
"""Largest distance of excitations from the standing pose; all legs then stay 3 cm apart."""


def _reach() -> tuple[tuple[float, float], ...]:
    """Return the range of excitations for each joint [rad]."""
    pose, reach = per_joint(STANDING_RAD), per_joint(REACH_RAD)
    return tuple((middle - way, middle + way) for middle, way in zip(pose, reach, strict=True))


DESCRIPTION: Final[RobotDescription] = dataclasses.replace(
    DRIVER,
    name="go2_on_stand",
    stiffness=on_stand_recording.DESCRIPTION.stiffness,
    damping=on_stand_recording.DESCRIPTION.damping,
    device_rate_hz=MOTOR_HZ,
    limits=driver_limits(FLOOR.limits, legs_on_stand()),
    mjcf=on_stand_recording.DESCRIPTION.mjcf,
    floating_base=None,
    excitation_range=_reach(),
    sources={
        **DRIVER.sources,
        "stiffness": on_stand_recording.DESCRIPTION.sources["stiffness"],
        "damping": on_stand_recording.DESCRIPTION.sources["damping"],
        "device_rate_hz": "1 kHz as the emulator's motors; the rate of the robot's own is not published",
        "excitation_range": "corners and draws inside it: least distance of two legs' shapes in go2.xml 3 cm",
        "legs.tilt": (
            "assumed: the model's base is level; at 0.35 rad a third of a leg's weight pulls it aside"
        ),
        "legs.free_fall": "no limit: the base is held",
    },
)

SPACES: Final = on_stand_recording.SPACES
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""


def on_floor(found: ParameterDistribution) -> ParameterDistribution:
    """Convert a result on the stand to the robot on the floor, whose policies send other gains.

    A motor multiplies the gain that it is sent by a factor. On the stand the damping is the sum of the
    motor's and the joint's. Motion determines only this sum, so the joint's share is taken from the model.

    Args:
        found: Distribution over the parameter set ``default`` of this robot.
    """
    gains = {
        "stiffness": (floor.STIFFNESS_NM_RAD / on_stand_recording.STIFFNESS_NM_RAD, 0.0),
        "damping": (
            floor.DAMPING_NMS_RAD / on_stand_recording.DAMPING_NMS_RAD,
            on_stand_recording.JOINT_DAMPING_NMS_RAD,
        ),
    }
    parameters, mean, spread = [], found.mean.copy(), np.ones(len(found.space))
    for k, p in enumerate(found.space):
        factor, offset = gains.get(p.name.rpartition(".")[2], (1.0, 0.0))
        # Damping below the joint's own would leave no share for the motor.
        mean[k] = factor * max(found.mean[k] - offset, LEAST_SHARE * found.mean[k])
        # On a log scale the same absolute uncertainty is a larger share of the remaining damping.
        spread[k] = factor * found.mean[k] / mean[k]
        nominal = factor * (p.nominal - offset)
        parameters.append(Parameter.around(p.name, p.kind, p.elements, p.unit, nominal, ratio=WIDEST))
    covariance = None if found.covariance is None else found.covariance * np.outer(spread, spread)
    return ParameterDistribution(
        space=ParameterSpace(parameters), mean=mean, covariance=covariance, latency_s=found.latency_s
    )
