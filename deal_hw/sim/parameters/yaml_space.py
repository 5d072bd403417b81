"""A user's params.yaml: the searched parameters of an MJCF, their ranges, and known values.

docs/reference/parameters.md describes the format. Nominal values come from the MJCF, so the file
holds only the user's changes.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from deal_hw.documentation import page
from deal_hw.errors import QUOTED, ConfigurationError, short, shown
from deal_hw.parameters import Parameter, ParameterSpace, Scale
from deal_hw.reading import YAML_BYTES, number, parse_yaml, read_bytes, reading
from deal_hw.sim.parameters import KIND_TABLE, check_space, find_kind
from deal_hw.sim.parameters.fields import element_id, element_names, unknown_name
from deal_hw.sim.parameters.kind import Kind
from deal_hw.sim.parameters.kind_sets import KIND_SETS, SetPart

_KEYS: Final = (
    "kind",
    "elements",
    "group",
    "name",
    "nominal",
    "range",
    "ratio",
    "scale",
    "known",
    "weighed",
    "prior",
)
_SET_KEYS: Final = ("kind", "elements", "weighed", "prior")
_GROUPS: Final = ("each", "together")
_SCALES: Final[Mapping[str, Scale]] = {"log": "log", "linear": "linear"}


def read_space(path: Path, model: Any) -> ParameterSpace:
    """Return the parameter space of a YAML file for a model.

    Args:
        path: The file.
        model: The MjModel of names and nominal values.

    Raises:
        ConfigurationError: The file cannot be used; the message names the entry and what to write instead.
        UnknownNameError: A kind or an element is not known; the message lists the names.
    """
    described = f"{page('reference/parameters.md')} describes them"
    with reading(path, "parameters", described, error=ConfigurationError):
        return parse_space(read_bytes(path, YAML_BYTES).decode("utf-8"), model, source=str(path))


def parse_space(text: str, model: Any, source: str = "params.yaml") -> ParameterSpace:
    """Return the parameter space of YAML text; see :func:`read_space`.

    Args:
        text: The YAML text.
        model: The MjModel.
        source: Name of the text in messages.
    """
    with reading(source, "YAML", error=ConfigurationError):
        content = parse_yaml(text)
    if not isinstance(content, Mapping) or list(content) != ["parameters"]:
        raise ConfigurationError(f"{source} must hold one key, `parameters`, with a list of entries")
    entries = content["parameters"]
    if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
        raise ConfigurationError(f"{source}: `parameters` must be a list with at least one entry")
    parameters: list[Parameter] = []
    for place, entry in enumerate(entries, 1):
        try:
            parameters += _parameters(entry, model)
        except ConfigurationError as err:
            err.args = (f"{source}, entry {place}: {err}",)
            raise
    names = [p.name for p in parameters]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigurationError(
            f"{source}: parameter names repeat: {short(twice)}; give one of them a `name`"
        )
    space = ParameterSpace(parameters)
    try:
        check_space(model, space)
    except ConfigurationError as err:
        err.args = (f"{source}: {err}",)
        raise
    return space


def _parameters(entry: Any, model: Any) -> list[Parameter]:
    if not isinstance(entry, Mapping):
        raise ConfigurationError(f"an entry must have keys ({', '.join(_KEYS)}), got {shown(entry)}")
    for key in entry:
        if key not in _KEYS:
            raise unknown_name("key", str(key), _KEYS)
    name = _text(entry, "kind")
    if name in KIND_SETS:
        return _set_of_kinds(entry, name, model)
    if name not in KIND_TABLE:
        raise unknown_name("parameter kind", name, (*KIND_TABLE, *KIND_SETS))
    kind = find_kind(name)
    elements = _elements(entry.get("elements"), kind, model)
    group = _choice(entry, "group", _GROUPS, "each")
    if group == "each" and "name" in entry and len(elements) > 1:
        raise ConfigurationError(
            f"`name` is for one parameter, but group `each` makes {len(elements)}; use group: together"
        )
    if group == "together" and "name" not in entry and len(elements) > 1:
        raise ConfigurationError(f"group `together` of {len(elements)} elements needs a `name`")
    groups = [tuple(elements)] if group == "together" else [(name,) for name in elements]
    return [_parameter(entry, kind, names, model) for names in groups]


def _set_of_kinds(entry: Mapping[str, Any], name: str, model: Any) -> list[Parameter]:
    """Return the parameters of a set of kinds, with the model's values as prior."""
    for key in entry:
        if key not in _SET_KEYS:
            raise ConfigurationError(
                f"`{key}` is not for {name}, which stands for several kinds: it takes "
                f"{', '.join(_SET_KEYS)}; for other ranges write an entry for each kind "
                f"({', '.join(kind for part in KIND_SETS[name].values() for kind in part.kinds)})"
            )
    parts = KIND_SETS[name]
    stds = entry.get("prior", {})
    if not isinstance(stds, Mapping):
        raise ConfigurationError(
            f"`prior` of {name} has a standard deviation for each part that differs from the usual, such as "
            f"{{mass: 0.02, com: 0.003}}; got {shown(stds)}"
        )
    for part in stds:
        if part not in parts:
            raise unknown_name(f"part of {name}", str(part), parts)
    kinds = [find_kind(kind) for part in parts.values() for kind in part.kinds]
    every = {element: None for kind in kinds for element in _elements(entry.get("elements"), kind, model)}
    if "weighed" in entry and len(every) > 1:
        raise ConfigurationError(
            f"`weighed` is one body's mass, but the entry names {len(every)}: {short(list(every))}"
        )
    found = []
    for element in every:
        for part_name, part in parts.items():
            std = _number(stds.get(part_name, part.prior_std), f"prior of {part_name}")
            for kind in part.kinds:
                weighed = entry.get("weighed") if kind == "body_mass" else None
                found += _part(kind, element, part, std, weighed, model)
    return found


def _part(kind: str, element: str, part: SetPart, std: float, weighed: Any, model: Any) -> list[Parameter]:
    if weighed is not None:
        return _parameters({"kind": kind, "elements": [element], "weighed": weighed}, model)
    found = find_kind(kind)
    assert found.baseline is not None
    mean = found.baseline(model, element_id(model, found.element, element))
    wide = (
        {"ratio": part.reach} if found.scale == "log" else {"range": [mean - part.reach, mean + part.reach]}
    )
    prior = {"mean": mean, "std": f"{100 * std} %" if found.scale == "log" else std}
    return _parameters({"kind": kind, "elements": [element], "prior": prior, **wide}, model)


def _elements(value: Any, kind: Kind, model: Any) -> list[str]:
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, Sequence) or not patterns or not all(isinstance(x, str) for x in patterns):
        raise ConfigurationError(
            f"`elements` must be a {kind.element} name, a pattern such as '*_hip', or a list of them; "
            f"got {shown(value)}"
        )
    names = [name for name in element_names(model, kind.element) if name]
    if kind.element == "body":
        names.remove("world")
    chosen: list[str] = []
    for pattern in patterns:
        literal = pattern in names
        found = [pattern] if literal else [name for name in names if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            raise unknown_name(f"MuJoCo {kind.element}", pattern, names)
        if not literal:
            found = _usable_ones(found, kind, model, pattern)
        chosen += [name for name in found if name not in chosen]
    return chosen


def _usable_ones(names: list[str], kind: Kind, model: Any, pattern: str) -> list[str]:
    """Return the matches of a pattern that can have the parameter; literal names are not filtered."""
    if kind.usable is None:
        return names
    kept, reason = [], ""
    for name in names:
        try:
            kind.usable(model, element_id(model, kind.element, name), name)
        except ConfigurationError as err:
            reason = str(err)
        else:
            kept.append(name)
    if not kept:
        raise ConfigurationError(f"{pattern!r} matches nothing that can have {kind.name}: {reason}")
    return kept


def _parameter(entry: Mapping[str, Any], kind: Kind, elements: tuple[str, ...], model: Any) -> Parameter:
    name = _text(entry, "name") if "name" in entry else f"{elements[0]}.{kind.quantity}"
    scale = _SCALES[_choice(entry, "scale", tuple(_SCALES), kind.scale)]
    if kind.usable is not None:
        # Before any use of the element: one that cannot have the parameter may have no such value.
        for element in elements:
            kind.usable(model, element_id(model, kind.element, element), element)
    known, value = _known(entry, name)
    nominal = _nominal(entry, kind, elements, model, name) if value is None else value
    low, high = _range(entry, kind, scale, nominal, name, known=known)
    mean, std = _prior(entry, name, scale)
    units = {kind.unit_of(model, element_id(model, kind.element, e)) for e in elements}
    if len(units) > 1:
        raise ConfigurationError(f"parameter {name!r} groups hinges with slides: their units differ, {units}")
    return Parameter(
        name=name,
        kind=kind.name,
        elements=elements,
        unit=units.pop(),
        nominal=nominal,
        low=low,
        high=high,
        scale=scale,
        known=known,
        prior_mean=mean,
        prior_std=std,
    )


def _nominal(entry: Mapping[str, Any], kind: Kind, elements: tuple[str, ...], model: Any, name: str) -> float:
    if "nominal" in entry:
        return _number(entry["nominal"], f"nominal of {name!r}")
    if kind.baseline is None:
        raise ConfigurationError(f"parameter {name!r}: an MJCF has no {kind.name}; give `nominal`")
    values = [kind.baseline(model, element_id(model, kind.element, e)) for e in elements]
    if not all(math.isclose(v, values[0], rel_tol=1e-6, abs_tol=1e-12) for v in values):
        pairs = ", ".join(f"{e} {v:g}" for e, v in zip(elements, values, strict=True))
        raise ConfigurationError(
            f"parameter {name!r} sets elements together that differ in the model ({pairs}); give `nominal`"
        )
    return values[0]


def _range(
    entry: Mapping[str, Any], kind: Kind, scale: Scale, nominal: float, name: str, *, known: bool
) -> tuple[float, float]:
    if "range" in entry and "ratio" in entry:
        raise ConfigurationError(f"parameter {name!r}: give `range` or `ratio`, not both")
    if "range" in entry:
        ends = entry["range"]
        if not isinstance(ends, Sequence) or isinstance(ends, str) or len(ends) != 2:
            raise ConfigurationError(f"parameter {name!r}: `range` must be [low, high], got {shown(ends)}")
        low, high = (_number(end, f"range of {name!r}") for end in ends)
        if low >= high:
            hint = "they are reversed" if low > high else "for a fixed value use `known`"
            raise ConfigurationError(
                f"parameter {name!r}: range [{low:g}, {high:g}] must have low < high; {hint}"
            )
        return low, high
    if "ratio" not in entry and scale == "linear":
        return kind.usual_range(nominal, scale)
    ratio = _number(entry.get("ratio", kind.ratio), f"ratio of {name!r}")
    if not ratio > 1:
        raise ConfigurationError(f"parameter {name!r}: `ratio` must be above 1, got {ratio:g}")
    if nominal <= 0:
        if known:
            # Not searched: any range around the value will do.
            return nominal - 1.0, nominal + 1.0
        raise ConfigurationError(
            f"parameter {name!r}: its value in the model is {nominal:g}, so a ratio gives no range; give a "
            "`nominal` above 0 or a `range`"
        )
    return max(nominal / ratio, kind.least), min(nominal * ratio, kind.most)


def _known(entry: Mapping[str, Any], name: str) -> tuple[bool, float | None]:
    """Return whether the value is known, and the value if the file gives one."""
    if "known" in entry and "weighed" in entry:
        raise ConfigurationError(f"parameter {name!r}: give `known` or `weighed`, not both")
    value = entry.get("known", entry.get("weighed", False))
    if isinstance(value, bool):
        return value, None
    if "nominal" in entry:
        raise ConfigurationError(f"parameter {name!r}: `known` holds a value already; leave out `nominal`")
    return True, _number(value, f"known value of {name!r}")


def _prior(entry: Mapping[str, Any], name: str, scale: Scale) -> tuple[float | None, float | None]:
    """Return the expected value, in the unit, and its standard deviation in the parameter's scale."""
    if "prior" not in entry:
        return None, None
    prior = entry["prior"]
    if not isinstance(prior, Mapping) or set(prior) != {"mean", "std"}:
        raise ConfigurationError(
            f"parameter {name!r}: `prior` must have `mean` and `std`, got {shown(prior)}"
        )
    mean, given = _number(prior["mean"], f"prior of {name!r}"), prior["std"]
    percent = isinstance(given, str) and given.endswith("%")
    std = _number(given[:-1] if percent else given, f"prior of {name!r}")
    if percent:
        return mean, std / 100 * (1.0 if scale == "log" else abs(mean))
    if scale == "log" and not mean > 0:
        raise ConfigurationError(f"parameter {name!r}: the prior's mean must be above 0, got {mean:g}")
    return mean, std / mean if scale == "log" else std


def _number(value: Any, what: str) -> float:
    # YAML 1.1 reads 1e-3 as text, because it lacks a point.
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            pass
    return number(value, f"the {what}")


def _text(entry: Mapping[str, Any], key: str) -> str:
    value = entry.get(key)
    if not isinstance(value, str) or not 0 < len(value) <= QUOTED:
        raise ConfigurationError(f"`{key}` must be a text of 1 to {QUOTED} characters, got {shown(value)}")
    return value


def _choice(entry: Mapping[str, Any], key: str, allowed: Sequence[str], default: str) -> str:
    value = entry.get(key, default)
    if value not in allowed:
        raise unknown_name(key, str(value), allowed)
    return str(value)
