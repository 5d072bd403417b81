"""Parameter kinds: the effect of a physical parameter on a MuJoCo model, one small function each.

A kind's ``apply(fields, elements, values)`` writes ``values`` (N,) for the named elements into the fields of
N simulations. The table :data:`KIND_TABLE` is explicit; new kinds go into the tuple of their element's file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.parameters.actuator import ACTUATOR_KINDS
from deal_hw.sim.parameters.body import BODY_KINDS
from deal_hw.sim.parameters.doubts import DOUBTS, Doubt
from deal_hw.sim.parameters.effort import EFFORT_KINDS, EFFORT_NOISE
from deal_hw.sim.parameters.fields import Array, Fields, element_id, unknown_name
from deal_hw.sim.parameters.geom import GEOM_KINDS, check_partners
from deal_hw.sim.parameters.inertia import INERTIA_KINDS
from deal_hw.sim.parameters.joint import JOINT_KINDS
from deal_hw.sim.parameters.kind import Apply, Kind, Together
from deal_hw.sim.parameters.laws import LAW_KINDS, SERVO_RESOLUTION, check_laws
from deal_hw.sim.parameters.sensor import SENSOR_KINDS
from deal_hw.sim.parameters.tendon import TENDON_KINDS
from deal_hw.sim.parameters.transmission import TRANSMISSION_KINDS, check_transmissions

KIND_TABLE: Mapping[str, Kind] = MappingProxyType(
    {
        k.name: k
        for k in (
            *BODY_KINDS,
            *INERTIA_KINDS,
            *JOINT_KINDS,
            *TENDON_KINDS,
            *GEOM_KINDS,
            *ACTUATOR_KINDS,
            *LAW_KINDS,
            *TRANSMISSION_KINDS,
            *SENSOR_KINDS,
            *EFFORT_KINDS,
        )
    }
)
"""Every kind by name."""

KINDS: Mapping[str, Apply] = MappingProxyType(
    {name: kind.apply for name, kind in KIND_TABLE.items() if kind.apply is not None}
)
"""Kinds with MuJoCo fields."""

DEVICE_KINDS = tuple(name for name, kind in KIND_TABLE.items() if kind.apply is None)
"""Kinds without a MuJoCo field: code between simulator, commands and recording applies them."""

SENSOR_NOISE = "sensor_noise"
"""A kind that cannot be searched, as that of efforts: it weights the recordings."""

SERVO_KINDS = ("servo_stiffness", "servo_damping", "servo_effort_limit", "servo_speed_limit")
"""Kinds that scale with the sent command."""


FORCE_KINDS = frozenset(
    {
        "body_mass",
        "dof_armature",
        "dof_damping",
        "dof_dampingpoly_square",
        "dof_dampingpoly_cube",
        "dof_frictionloss",
        "dof_friction_stribeck",
        "joint_stiffness",
        "tendon_frictionloss",
        "tendon_damping",
        "servo_stiffness",
        "servo_damping",
        "servo_effort_limit",
        "servo_punch",
        "motor_gain",
        "motor_gear",
        "transmission_stiffness",
        "transmission_damping",
    }
)
"""Kinds that scale together without a trace in any motion: masses, and all that is a force."""


def find_kind(name: str) -> Kind:
    """Return the kind with a name.

    Raises:
        UnknownNameError: There is none; the message lists the kinds, and the nearest one if any is near.
    """
    if name not in KIND_TABLE:
        raise unknown_name("parameter kind", name, KIND_TABLE)
    return KIND_TABLE[name]


def with_usual_range(space: ParameterSpace) -> tuple[str, ...]:
    """Return the searched parameters whose range is the usual one of their kind: nobody chose it.

    One whose expected value somebody gave is none of them.
    """
    return tuple(p.name for p in space if _has_usual_range(p) and (p.prior_std is None or _is_doubted(p)))


def with_doubts(space: ParameterSpace) -> ParameterSpace:
    """Return the space in which searched values of which nobody said anything have the usual prior.

    It is as wide as models usually err (:data:`~deal_hw.sim.parameters.doubts.DOUBTS`), around the nominal
    value. A range that somebody chose says what they expect, and a prior that they gave says more.
    """
    return ParameterSpace(
        dataclasses.replace(p, prior_mean=p.nominal, prior_std=DOUBTS[p.kind].std)
        if _doubt_of(p) is not None and not p.known and p.prior_std is None and _has_usual_range(p)
        else p
        for p in space.parameters
    )


def without_masses_and_zeros(space: ParameterSpace) -> ParameterSpace:
    """Return the space without what its owner may have measured: masses of bodies and zeros of encoders."""
    return ParameterSpace(p for p in space.parameters if p.kind not in ("body_mass", "encoder_bias"))


def _has_usual_range(p: Parameter) -> bool:
    return (p.low, p.high) == find_kind(p.kind).usual_range(p.nominal, p.scale)


def _is_doubted(p: Parameter) -> bool:
    doubt = _doubt_of(p)
    return doubt is not None and (p.prior_mean, p.prior_std) == (p.nominal, doubt.std)


def _doubt_of(p: Parameter) -> Doubt | None:
    """Return the usual doubt of a parameter; None where there is none on its scale."""
    return DOUBTS.get(p.kind) if p.scale == find_kind(p.kind).scale else None


def wider(space: ParameterSpace, sides: Mapping[str, int]) -> ParameterSpace:
    """Return the space with ranges that go on at one end, by as much as the usual one does from its value.

    Args:
        space: The parameters.
        sides: For each parameter whose range goes on, by name: -1 at its lower end, 1 at its higher one. No
            range passes what its kind allows.
    """
    for name, side in sides.items():
        p = space[name]
        low, high = find_kind(p.kind).usual_range(p.low if side < 0 else p.high, p.scale)
        space = space.with_range(name, *((low, p.high) if side < 0 else (p.low, high)))
    return space


def check_kinds(space: ParameterSpace) -> None:
    """Raise `UnknownNameError`, which lists the kinds, for a parameter of an unknown kind."""
    for parameter in space.parameters:
        find_kind(parameter.kind)


def check_space(model: Any, space: ParameterSpace) -> None:
    """Check that a model has the parameters' elements, and that their values can act there.

    Args:
        model: The MjModel.
        space: The parameters.

    Raises:
        UnknownNameError: A kind or an element is not known; the message lists the names.
        ConfigurationError: A value is outside what the kind allows, an element cannot have the parameter, two
            parameters write the same field, or another geom overrides a contact parameter.
    """
    check_laws(space)
    owner: dict[tuple[str, str], str] = {}
    for p in space.parameters:
        kind = find_kind(p.kind)
        _check_bounds(p, kind)
        _check_searchable(p)
        for name in p.elements:
            index = element_id(model, kind.element, name)
            if kind.usable is not None:
                try:
                    kind.usable(model, index, name)
                except ConfigurationError as err:
                    raise ConfigurationError(f"parameter {p.name!r} ({p.kind}): {err}") from err
            first = owner.setdefault((p.kind, name), p.name)
            if first != p.name:
                raise ConfigurationError(
                    f"parameters {first!r} and {p.name!r} both set {p.kind} of {name!r}; keep one"
                )
        if p.kind in ("geom_friction", "geom_restitution"):
            check_partners(model, p.kind, p.elements, p.low)
    check_transmissions(model, space)
    for (name, element), first in owner.items():
        for other in KIND_TABLE[name].excludes:
            if (other, element) in owner:
                raise ConfigurationError(
                    f"parameters {first!r} ({name}) and {owner[other, element]!r} ({other}) both change the "
                    f"inertia of {element!r}; keep one of them"
                )


def _check_searchable(p: Parameter) -> None:
    if p.kind in (SENSOR_NOISE, EFFORT_NOISE) and not p.known:
        raise ConfigurationError(
            f"parameter {p.name!r}: noise of a sensor changes no prediction, so no search can find it; "
            "leave it out (it is estimated from the recording) or give the value you measured, "
            f"`known: {p.nominal:g}`"
        )
    if p.kind == SERVO_RESOLUTION and not p.known:
        raise ConfigurationError(
            f"parameter {p.name!r}: motion follows the counts of an encoder in jumps, so no search can find "
            "their size; give that of the data sheet, `known: 0.001534` for 4096 counts a turn"
        )


def _check_bounds(p: Parameter, kind: Kind) -> None:
    if p.low < kind.least or p.high > kind.most:
        raise ConfigurationError(
            f"parameter {p.name!r}: range [{p.low:g}, {p.high:g}] {p.unit} exceeds what {p.kind} allows, "
            f"[{kind.least:g}, {kind.most:g}]; narrow the range"
        )
    if not p.elements:
        raise ConfigurationError(f"parameter {p.name!r} names no {kind.element}; list its `elements`")


def present(
    space: ParameterSpace, absent: Collection[tuple[str, str]], own: Collection[str] = ()
) -> ParameterSpace:
    """Return the parameters without elements that are in another set-up only; some may have none.

    Args:
        space: The parameters.
        absent: Type and name of elements that a model lacks, such as ("body", "payload").
        own: Set-ups whose own parameters act.
    """
    if not absent and not any(p.setup for p in space.parameters):
        return space

    def here(p: Parameter) -> tuple[str, ...]:
        if p.setup and p.setup not in own:
            return ()
        return tuple(e for e in p.elements if (find_kind(p.kind).element, e) not in absent)

    return ParameterSpace(dataclasses.replace(p, elements=here(p)) for p in space.parameters)


def apply_parameters(fields: Fields, space: ParameterSpace, theta: Array) -> None:
    """Write free parameters (N, K), and the known ones, into the fields of N simulations.

    Args:
        fields: Where to write.
        space: The parameters.
        theta: Physical values of the free parameters, (N, K).
    """
    check_kinds(space)
    count = theta.shape[0]
    columns = {name: theta[:, k] for k, name in enumerate(space.names)}
    used = [(KIND_TABLE[p.kind], p) for p in space.parameters if p.kind in KINDS]
    # Kinds that scale or shift a field start from the model each time, or changes would accumulate.
    for field in sorted({field for kind, _ in used if kind.relative for field in kind.writes}):
        fields.get(field)[:] = getattr(fields.model, field)
    waiting: dict[tuple[Together, str], dict[str, Array]] = {}
    for kind, parameter in sorted(used, key=lambda pair: pair[0].order):
        values = columns.get(parameter.name)
        if values is None:
            values = np.full(count, parameter.nominal)
        if kind.together is None:
            KINDS[parameter.kind](fields, parameter.elements, values)
            continue
        for element in parameter.elements:
            waiting.setdefault((kind.together, element), {})[parameter.kind] = values
    for (write, element), parts in waiting.items():
        write(fields, element, parts)
