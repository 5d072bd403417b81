"""Parameter kinds of laws that no MuJoCo field holds: friction, effort by speed, servos' firmware.

Their equations are in :mod:`deal_hw.sim.laws`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import mujoco

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.parameters.kind import FRICTION_RATIO, Kind, joint_of, one_dof_joint

STRIBECK_SPEED = 0.1
"""Speed at which Stribeck friction has fallen to 1/e where no parameter says it [rad/s or m/s].

Identified servos have 1.6 to 2.9 rad/s (BAM, commit 1b5a1cee, bam/params); gears of legs and belts less."""

FREE_SPEED = "motor_free_speed"

FRICTION_KINDS: Mapping[str, Sequence[str]] = MappingProxyType(
    {
        "dof_friction_stribeck": ("stribeck",),
        "dof_stribeck_speed": ("stribeck_speed",),
        "dof_friction_load": ("motor", "external"),
        "dof_friction_motor": ("motor",),
        "dof_friction_external": ("external",),
        "dof_friction_load_stribeck": ("motor_stribeck", "external_stribeck"),
        "dof_friction_motor_stribeck": ("motor_stribeck",),
        "dof_friction_external_stribeck": ("external_stribeck",),
    }
)
"""Kinds that are laws of friction, and the coefficients of `FrictionLaw` that they set."""

SERVO_RESOLUTION = "servo_resolution"
SERVO_PUNCH = "servo_punch"

SERVO_LAW_KINDS: Mapping[str, str] = MappingProxyType(
    {SERVO_RESOLUTION: "resolution", "servo_dead_zone": "dead_zone", SERVO_PUNCH: "punch"}
)
"""Kinds that are laws of a servo's firmware, and the parts of `ServoLaw` that they set."""

_INTEGRATORS = ("Euler", "implicit", "implicitfast")
"""Integrators that hold a servo's effort against its position for a whole step."""


def _friction(name: str, *, quantity: str, unit: str, slide: str, along: str, least: float = 0.0) -> Kind:
    return Kind(
        name=name,
        element="joint",
        quantity=quantity,
        unit=unit,
        unit_slide=slide,
        writes=(),
        along=along,
        apply=None,
        baseline=None,
        usable=one_dof_joint,
        ratio=FRICTION_RATIO,
        least=least,
    )


def _limited(model: Any, actuator: int, name: str) -> None:
    if joint_of(model, actuator) < 0:
        raise ConfigurationError(f"actuator {name!r} drives no joint, so it has no speed of its own")
    if not model.actuator_forcelimited[actuator]:
        raise ConfigurationError(
            f"actuator {name!r} has no effort limit that could fall with speed; give it a `forcerange` in "
            "the MJCF, its effort at standstill to both sides"
        )


def _error_known(model: Any, actuator: int, name: str) -> None:
    if drive_of(model, actuator, name).takes != "position":
        raise ConfigurationError(
            f"actuator {name!r} is no position servo, so it compares no position with a goal; for a motor "
            "use command_dead_zone"
        )
    check_integrator(model, "the effort of a servo", ", and its firmware does not")


def check_integrator(model: Any, effort: str, but: str = "") -> None:
    """Refuse integrators that change an effort within a step.

    Args:
        model: The MjModel.
        effort: The effort, in words.
        but: What does not change within it, in words.

    Raises:
        ConfigurationError: Such an integrator; the message names those that hold efforts.
    """
    used = mujoco.mjtIntegrator(int(model.opt.integrator)).name.removeprefix("mjINT_")
    if used not in {name.upper() for name in _INTEGRATORS}:
        raise ConfigurationError(
            f"the integrator {used} changes {effort} within a step{but}; "
            f'write <option integrator="..."/> with one of {", ".join(_INTEGRATORS)}'
        )


def check_laws(space: ParameterSpace) -> None:
    """Refuse two parameters that set one coefficient of a joint's friction.

    Raises:
        ConfigurationError: Such two; the message names them.
    """
    owner: dict[tuple[str, str], tuple[str, str]] = {}
    for p in space.parameters:
        for coefficient in FRICTION_KINDS.get(p.kind, ()):
            for joint in p.elements:
                first, kind = owner.setdefault((coefficient, joint), (p.name, p.kind))
                if first != p.name:
                    raise ConfigurationError(
                        f"parameters {first!r} ({kind}) and {p.name!r} ({p.kind}) both set friction of "
                        f"{joint!r} by load, so its effect would be double; keep one, or the pair of "
                        "dof_friction_motor and dof_friction_external"
                    )


LAW_KINDS = (
    _friction(
        "dof_friction_stribeck",
        quantity="friction_stribeck",
        unit="N·m",
        slide="N",
        along="dry friction at rest is larger by it than dof_frictionloss; smaller, if it is negative",
        least=float("-inf"),
    ),
    _friction(
        "dof_stribeck_speed",
        quantity="stribeck_speed",
        unit="rad/s",
        slide="m/s",
        along="speed at which the further friction at rest has fallen to 1/e",
    ),
    _friction(
        "dof_friction_load",
        quantity="friction_load",
        unit="-",
        slide="-",
        along="dry friction grows by it times the difference of motor torque and outside torque",
    ),
    _friction(
        "dof_friction_motor",
        quantity="friction_motor",
        unit="-",
        slide="-",
        along="the same with its own factor of the motor torque",
    ),
    _friction(
        "dof_friction_external",
        quantity="friction_external",
        unit="-",
        slide="-",
        along="the same with its own factor of the outside torque",
    ),
    _friction(
        "dof_friction_load_stribeck",
        quantity="friction_load_stribeck",
        unit="-",
        slide="-",
        along="as dof_friction_load, but only near rest (dof_stribeck_speed)",
    ),
    _friction(
        "dof_friction_motor_stribeck",
        quantity="friction_motor_stribeck",
        unit="-",
        slide="-",
        along="as dof_friction_motor, but only near rest",
    ),
    _friction(
        "dof_friction_external_stribeck",
        quantity="friction_external_stribeck",
        unit="-",
        slide="-",
        along="as dof_friction_external, but only near rest",
    ),
    Kind(
        name=FREE_SPEED,
        element="actuator",
        quantity="free_speed",
        unit="rad/s",
        unit_slide="m/s",
        writes=(),
        along="the effort limit falls with speed to 0 there (a motor on a limited voltage)",
        apply=None,
        baseline=None,
        usable=_limited,
    ),
    Kind(
        name=SERVO_RESOLUTION,
        element="actuator",
        quantity="servo_resolution",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="goal and reading are compared in steps of it, the encoder's counts; `known` only",
        apply=None,
        baseline=None,
        usable=_error_known,
    ),
    Kind(
        name="servo_dead_zone",
        element="actuator",
        quantity="servo_dead_zone",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="errors of the position up to this size have no effort, larger ones lose it",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_error_known,
        scale="linear",
        spread=0.03,
    ),
    Kind(
        name=SERVO_PUNCH,
        element="actuator",
        quantity="servo_punch",
        unit="N·m",
        unit_slide="N",
        writes=(),
        along="effort that a servo begins with just beyond its dead zone",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_error_known,
        scale="linear",
        spread=0.3,
    ),
)
