"""The MJCF attribute of each compiled field of an MjModel, and the fields that follow from others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")


@dataclass(frozen=True, slots=True)
class Attribute:
    """One attribute and its compiled fields.

    Attributes:
        name: The attribute.
        fields: Compiled fields whose values it holds, in this order.
        trim: Trailing zeros may be left out: the attribute has a varying number of values.
        angle: The values are angles of turning joints, in degrees if the compiler says so.
        flag: The value is a truth value.
        drop: Other attributes with the same meaning; they are removed.
    """

    name: str
    fields: tuple[str, ...]
    trim: bool = False
    angle: bool = False
    flag: bool = False
    drop: tuple[str, ...] = ()


DOF = (
    Attribute("damping", ("dof_damping", "dof_dampingpoly"), trim=True),
    Attribute("armature", ("dof_armature",)),
    Attribute("frictionloss", ("dof_frictionloss",)),
    Attribute("solreffriction", ("dof_solref",)),
    Attribute("solimpfriction", ("dof_solimp",)),
)
"""Attributes of a joint whose fields have a row for each degree of freedom."""

JOINT = (
    Attribute("stiffness", ("jnt_stiffness", "jnt_stiffnesspoly"), trim=True),
    Attribute("range", ("jnt_range",), angle=True),
    Attribute("limited", ("jnt_limited",), flag=True),
    Attribute("solreflimit", ("jnt_solref",)),
    Attribute("solimplimit", ("jnt_solimp",)),
    Attribute("margin", ("jnt_margin",)),
    Attribute("pos", ("jnt_pos",)),
    Attribute("axis", ("jnt_axis",)),
    Attribute("actuatorfrcrange", ("jnt_actfrcrange",)),
    Attribute("actuatorfrclimited", ("jnt_actfrclimited",), flag=True),
)

GEOM = (
    Attribute("friction", ("geom_friction",)),
    Attribute("solref", ("geom_solref",)),
    Attribute("solimp", ("geom_solimp",)),
    Attribute("solmix", ("geom_solmix",)),
    Attribute("margin", ("geom_margin",)),
    Attribute("gap", ("geom_gap",)),
    Attribute("condim", ("geom_condim",)),
    Attribute("priority", ("geom_priority",)),
    Attribute("pos", ("geom_pos",), drop=("fromto",)),
    Attribute("quat", ("geom_quat",), drop=("fromto", *ORIENTATIONS)),
    Attribute("size", ("geom_size",), drop=("fromto",)),
)

ACTUATOR = (
    Attribute("forcerange", ("actuator_forcerange",)),
    Attribute("forcelimited", ("actuator_forcelimited",), flag=True),
    Attribute("ctrlrange", ("actuator_ctrlrange",), drop=("inheritrange",)),
    Attribute("ctrllimited", ("actuator_ctrllimited",), flag=True),
    Attribute("gear", ("actuator_gear",)),
    Attribute("armature", ("actuator_armature",)),
    Attribute("damping", ("actuator_damping", "actuator_dampingpoly"), trim=True),
    Attribute("delay", ("actuator_delay",)),
)
GAIN_FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_dynprm")
"""Written as kp and kv in elements that have these."""

TYPE_FIELDS = ("actuator_gaintype", "actuator_biastype", "actuator_dyntype")

INERTIA_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat")

TABLES: Mapping[str, tuple[Attribute, ...]] = {
    "joint": JOINT,
    "dof": DOF,
    "qpos": (
        Attribute("ref", ("qpos0",), angle=True),
        Attribute("springref", ("qpos_spring",), angle=True),
    ),
    "geom": GEOM,
    "actuator": ACTUATOR,
    "body": (
        Attribute("pos", ("body_pos",)),
        Attribute("quat", ("body_quat",), drop=ORIENTATIONS),
        Attribute("gravcomp", ("body_gravcomp",)),
    ),
    "site": (
        Attribute("pos", ("site_pos",), drop=("fromto",)),
        Attribute("quat", ("site_quat",), drop=("fromto", *ORIENTATIONS)),
    ),
    "tendon": (
        Attribute("stiffness", ("tendon_stiffness", "tendon_stiffnesspoly"), trim=True),
        Attribute("damping", ("tendon_damping", "tendon_dampingpoly"), trim=True),
        Attribute("frictionloss", ("tendon_frictionloss",)),
        Attribute("armature", ("tendon_armature",)),
        Attribute("springlength", ("tendon_lengthspring",)),
    ),
    "equality": (
        Attribute("solref", ("eq_solref",)),
        Attribute("solimp", ("eq_solimp",)),
    ),
    "pair": (
        Attribute("friction", ("pair_friction",)),
        Attribute("solref", ("pair_solref",)),
        Attribute("solreffriction", ("pair_solreffriction",)),
        Attribute("solimp", ("pair_solimp",)),
    ),
}
"""Attributes that can be written, by kind of element."""

OPTION_WORDS: Mapping[str, tuple[str, ...]] = {
    "integrator": ("Euler", "RK4", "implicit", "implicitfast"),
    "cone": ("pyramidal", "elliptic"),
    "jacobian": ("dense", "sparse", "auto"),
    "solver": ("PGS", "CG", "Newton"),
}
OPTIONS = (
    "timestep",
    "gravity",
    "wind",
    "magnetic",
    "density",
    "viscosity",
    "impratio",
    "tolerance",
    "ls_tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "o_margin",
    "o_solref",
    "o_solimp",
    "o_friction",
    *OPTION_WORDS,
)
"""Options that can be written; names are equal in MJCF and ``MjModel.opt``."""

ACTUATOR_WORDS: Mapping[str, tuple[str, ...]] = {
    "gaintype": ("fixed", "affine", "muscle"),
    "biastype": ("none", "affine", "muscle"),
    "dyntype": ("none", "integrator", "filter", "filterexact", "muscle"),
}

FOLLOWS = frozenset(
    {
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "dof_M0",
        "tendon_invweight0",
        "tendon_length0",
        "actuator_acc0",
        "actuator_length0",
        "dof_length",
    }
)
"""Computed by ``mj_setConst`` from other fields: not written, but compared afterwards."""

COMPILED = frozenset(
    {
        "actuator_lengthrange",
        "geom_aabb",
        "geom_rbound",
        "geom_fluid",
        "body_margin",
        "body_simple",
        "body_sameframe",
        "geom_sameframe",
        "site_sameframe",
        "dof_simplenum",
        "cam_pos0",
        "cam_poscom0",
        "cam_mat0",
        "light_pos0",
        "light_poscom0",
        "light_dir0",
    }
)
"""Computed only by the compiler: a model that was changed after compiling may hold the older value."""

COMPILED_PREFIXES = ("bvh_", "body_bvh", "oct_", "efm0_", "efmC_", "flexedge_", "B_", "D_", "M_", "map")
TEXT_PREFIXES = ("name_", "names_", "numeric_", "text_")
"""Tables of names and of custom elements, of which the written file has more."""


def is_text(field: str) -> bool:
    """Return whether a field only lists names, paths or custom elements."""
    return field.startswith(TEXT_PREFIXES) or field.endswith("_pathadr")


def is_compiled(field: str) -> bool:
    """Return whether a field is the compiler's own and not compared."""
    return field in COMPILED or field.startswith(COMPILED_PREFIXES)
