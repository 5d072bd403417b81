"""A parameter kind: a name, the elements it is for, and the function that writes its values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, Scale
from deal_hw.sim.parameters.fields import Array, Fields

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
OF_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

RATIO = 5.0
"""Usual accuracy of a published model: a factor on either side."""
FRICTION_RATIO = 20.0
"""The same for dry friction, which few models have measured: a real SO-101 has 8 to 9 times the model's."""
DAMPING_RATIO = 10.0
"""The same for damping, which few have measured either, and to which a motor's back-EMF adds."""

Apply = Callable[[Fields, Sequence[str], Array], None]
Together = Callable[[Fields, str, Mapping[str, Array]], None]
Element = Literal["body", "joint", "geom", "actuator", "tendon"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One kind of physical parameter.

    Attributes:
        name: Name in ``Parameter.kind`` and in params.yaml.
        element: Type of its elements.
        quantity: Last part of a parameter's name, ``<element>.<quantity>``.
        unit: SI unit; for joints and actuators that of a hinge.
        unit_slide: SI unit for a slide joint, if it differs.
        writes: MjModel fields that it changes; empty for a kind without a field.
        along: Other changes that it makes, in words.
        apply: Writes values (N,) for the named elements into the fields of N simulations; None for a kind
            that code outside MuJoCo applies.
        baseline: Returns a model's value for an element; None: there is none, so params.yaml must give it.
        usable: Raises if the element cannot have this parameter.
        scale: Default scale.
        ratio: Default half width of the range on a log scale: a factor on either side.
        spread: Default half width of the range on a linear scale, in the unit.
        least: Lowest allowed value.
        most: Highest allowed value.
        order: Kinds of lower order are applied first.
        relative: Multiplies or adds to the fields, which are therefore reset before.
        together: Writes the values of several kinds, (N,) each by their names, for one element at once; all
            kinds with this function are passed to it, after all others. None: each kind is written alone.
        excludes: Kinds with the same effect: they and this one cannot be set for one element.
    """

    name: str
    element: Element
    quantity: str
    unit: str
    writes: tuple[str, ...]
    along: str
    apply: Apply | None
    baseline: Callable[[Any, int], float] | None
    unit_slide: str = ""
    usable: Callable[[Any, int, str], None] | None = None
    scale: Scale = "log"
    ratio: float = RATIO
    spread: float = 0.0
    least: float = 0.0
    most: float = float("inf")
    order: int = 2
    relative: bool = False
    together: Together | None = None
    excludes: tuple[str, ...] = ()

    def usual_range(self, nominal: float, scale: Scale) -> tuple[float, float]:
        """Return the search range around a value where nobody gave one; above 0 on a log scale."""
        if scale == "linear":
            width = self.spread or abs(nominal) or 1.0
            return max(nominal - width, self.least), min(nominal + width, self.most)
        return max(nominal / self.ratio, self.least), min(nominal * self.ratio, self.most)

    def usual_parameter(self, model: Any, index: int, element: str) -> Parameter:
        """Return the parameter of one element with the model's value, and the usual range around it.

        Args:
            model: The MjModel.
            index: Number of the element.
            element: Its name.

        Raises:
            ConfigurationError: An MJCF has no such value, or it gives no range.
        """
        if self.baseline is None:
            raise ConfigurationError(f"an MJCF has no {self.name}, so {element!r} has no usual one")
        nominal = self.baseline(model, index)
        low, high = self.usual_range(nominal, self.scale)
        return Parameter(
            name=f"{element}.{self.quantity}",
            kind=self.name,
            elements=(element,),
            unit=self.unit_of(model, index),
            nominal=nominal,
            low=low,
            high=high,
            scale=self.scale,
        )

    def unit_of(self, model: Any, index: int) -> str:
        """Return the unit for one element of a model."""
        if not self.unit_slide:
            return self.unit
        joint = index if self.element == "joint" else joint_of(model, index)
        slides = joint >= 0 and int(model.jnt_type[joint]) == SLIDE
        return self.unit_slide if slides else self.unit


def joint_of(model: Any, actuator: int) -> int:
    """Return the joint that an actuator drives, or -1."""
    return int(model.actuator_trnid[actuator, 0]) if int(model.actuator_trntype[actuator]) in OF_JOINT else -1


def one_dof_joint(model: Any, joint: int, name: str) -> None:
    """Refuse ball and free joints, whose degrees of freedom have no own names."""
    if int(model.jnt_type[joint]) not in (HINGE, SLIDE):
        raise ConfigurationError(f"joint {name!r} is a ball or free joint; name hinges and slides")


def moving_body(model: Any, body: int, name: str) -> None:
    """Refuse bodies whose mass has no effect on motion: fixed to the world, or without mass."""
    if model.body_weldid[body] == 0:
        raise ConfigurationError(
            f"body {name!r} is fixed to the world, so its mass has no effect; leave it out or give it a joint"
        )
    if model.body_mass[body] <= 0:
        raise ConfigurationError(
            f"body {name!r} has no mass in the model, so there is nothing to scale; leave it out"
        )


def touching_geom(model: Any, geom: int, name: str) -> None:
    """Refuse geoms that touch nothing."""
    if not model.geom_contype[geom] and not model.geom_conaffinity[geom]:
        raise ConfigurationError(
            f"geom {name!r} touches nothing (contype and conaffinity are 0), so this parameter has no "
            "effect; leave it out"
        )
