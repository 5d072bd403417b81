"""Changes of MJCF elements from differences of compiled models."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf import tables
from deal_hw.sim.mjcf.tables import Attribute
from deal_hw.sim.mjcf.text import Element

Mask = npt.NDArray[np.bool_]
SAME = 1e-12
"""Relative difference up to which two compiled values count as the same."""

_OBJECTS = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
    "tendon": (mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "equality": (mujoco.mjtObj.mjOBJ_EQUALITY, "neq"),
    "pair": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
}
_MACROS = ("replicate", "composite", "flexcomp", "attach")
"""Elements that make others without a text of their own in the file."""

_DOFS = {0: 6, 1: 3, 2: 1, 3: 1}
"""Degrees of freedom by joint type: free, ball, slide, hinge."""


def arrays(model: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and values of each array of an MjModel."""
    for name in dir(model):
        if not name.startswith("_"):
            value = getattr(model, name)
            if isinstance(value, np.ndarray):
                yield name, value


def differences(have: Any, want: Any, tolerance: float = SAME, zero: float = 0.0) -> dict[str, Mask]:
    """Return where two compiled models differ, by field, without fields that MuJoCo derives from others.

    Args:
        have: One model.
        want: The other one.
        tolerance: Relative difference up to which values are the same.
        zero: Difference up to which they are: values near zero after a rotation are rounding errors.

    Raises:
        ConfigurationError: The models have different elements.
    """
    found = {}
    for name, value in arrays(have):
        if name in tables.FOLLOWS or tables.is_compiled(name) or tables.is_text(name):
            continue
        other = getattr(want, name)
        if other.shape != value.shape:
            raise ConfigurationError(
                f"the calibrated model has other elements than the file: {name} has shape {other.shape}, in "
                f"the file {value.shape}"
            )
        mask = ~np.isclose(value, other, rtol=tolerance, atol=zero, equal_nan=True)
        if mask.any():
            found[name] = mask
    return found


def number(value: float) -> str:
    """Format a number that reads back to the same double."""
    # MuJoCo's reader refuses numbers below the smallest normal one.
    return repr(float(value)).removesuffix(".0") if abs(value) >= np.finfo(float).tiny else "0"


def numbers(values: Iterable[float]) -> str:
    """Format numbers as an attribute's value."""
    return " ".join(number(v) for v in values)


class NotInTextError(ConfigurationError):
    """An element that must change has no text of its own in the file."""


class MjcfChanges:
    """Writes differences of compiled models into the elements of a file.

    Args:
        root: Root element of the main file, included files spliced in.
        model: The compiled file: it names the elements.
        degrees: The compiler reads angles in degrees.
        rounded: Relative error of the file's numbers: smaller differences are not written.
    """

    def __init__(self, root: Element, model: Any, degrees: bool, rounded: float = SAME) -> None:
        self.root = root
        self._rounded = rounded
        self.degrees = degrees
        self.log: dict[tuple[str, str, str], tuple[str, str]] = {}
        self._elements = _index(root, model)
        self._model = model
        self._option: Element | None = None

    def apply(self, have: Any, want: Any) -> bool:
        """Change elements so that the file that compiles to ``have`` compiles to ``want``.

        Returns:
            Whether there was anything to change.

        Raises:
            ConfigurationError: A field differs that no attribute holds, or an element cannot be found.
        """
        masks = differences(have, want, self._rounded, self._rounded if self._rounded > SAME else 0.0)
        options = self._options(have.opt, want.opt)
        written: set[str] = set()
        for kind, attributes in tables.TABLES.items():
            for attribute in attributes:
                self._attribute(kind, attribute, have, want, masks)
                written.update(attribute.fields)
        for i in _rows(masks, tables.INERTIA_FIELDS):
            self._inertia(i, have, want)
        for i in _rows(masks, (*tables.GAIN_FIELDS, *tables.TYPE_FIELDS)):
            self._gains(i, have, want)
        written.update(tables.INERTIA_FIELDS, tables.GAIN_FIELDS, tables.TYPE_FIELDS)
        unknown = sorted(set(masks) - written)
        if unknown:
            raise ConfigurationError(
                f"calibrated values changed {', '.join(unknown)}, which cannot be written into an MJCF; "
                f"fields that can: {', '.join(sorted(written))}"
            )
        return bool(masks) or options

    def find(self, kind: str, index: int) -> Element:
        """Return the element of a compiled object.

        Raises:
            NotInTextError: It is not in the file's text.
        """
        element = self._elements[kind][index]
        if element is None:
            raise NotInTextError(
                f"{self._name(kind, index)} must change, but it is not in the MJCF's text (it has no name, "
                "or <replicate>, <composite> or <attach> makes it): give it a name or write it out"
            )
        return element

    def _name(self, kind: str, index: int) -> str:
        name = mujoco.mj_id2name(self._model, _OBJECTS[kind][0], index)
        return f"{kind} {name!r}" if name else f"{kind} {index}"

    def _set(self, kind: str, index: int, element: Element, name: str, value: str, old: str) -> None:
        element.set(name, value)
        key = (kind, self._name(kind, index), name)
        self.log[key] = (self.log.get(key, (old, ""))[0], value)

    def _attribute(
        self, kind: str, attribute: Attribute, have: Any, want: Any, masks: Mapping[str, Mask]
    ) -> None:
        target = "joint" if kind in ("dof", "qpos") else kind
        rows = _rows(masks, attribute.fields)
        if kind == "dof":
            rows = sorted({int(have.dof_jntid[row]) for row in rows})
        elif kind == "qpos":
            rows = sorted({int(np.searchsorted(have.jnt_qposadr, row, side="right")) - 1 for row in rows})
        for i in rows:
            element = self.find(target, i)
            if element.name == "freejoint":
                self._unfold_freejoint(i, element, want)
            self._write(target, kind, i, element, attribute, have, want)
            if attribute.name in ("damping", "stiffness") and self._springdamper(element):
                # It would overwrite both when the file is compiled.
                element.set("springdamper", "0 0")
            placed = attribute.name in ("pos", "quat", "size") and "fromto" in attribute.drop
            if kind == "geom" and placed and int(have.geom_type[i]) == mujoco.mjtGeom.mjGEOM_MESH:
                raise ConfigurationError(
                    f"{self._name('geom', i)} is a mesh: its place in the compiled model is not the file's"
                )
            if placed and element.get("fromto") is not None:
                for other in tables.TABLES[kind]:
                    if other.name in ("pos", "quat", "size"):
                        self._write(kind, kind, i, element, other, have, want)
            for name in attribute.drop:
                element.set(name, None)

    def _write(
        self, target: str, kind: str, i: int, element: Element, attribute: Attribute, have: Any, want: Any
    ) -> None:
        new, old = self._value(kind, i, attribute, want, have), self._value(kind, i, attribute, have, want)
        self._set(target, i, element, attribute.name, new, old)

    def _value(self, kind: str, i: int, attribute: Attribute, model: Any, other: Any) -> str:
        value, beside = (_values(kind, i, attribute, m) for m in (model, other))
        if attribute.flag:
            return "true" if value[0] else "false"
        if attribute.angle and self.degrees and int(model.jnt_type[i]) in (1, 3):
            value = np.rad2deg(value)
        if attribute.trim:
            used = np.flatnonzero((value != 0) | (beside != 0))
            value = value[: int(used[-1]) + 1 if len(used) else 1]
        return numbers(value)

    def _springdamper(self, element: Element) -> bool:
        classes = (e for section in self.root.spliced() if section.tag == "default" for e in section.walk())
        return any(e.get("springdamper") is not None for e in (element, *classes))

    def _unfold_freejoint(self, i: int, element: Element, want: Any) -> None:
        # Joint defaults apply to <joint type="free"> but not to <freejoint>: everything is written out.
        element.rename = "joint"
        element.set("type", "free")
        element.set("align", None)
        element.set("limited", "false")
        for kind, attributes in (("joint", tables.JOINT[:1]), ("dof", tables.DOF)):
            for attribute in attributes:
                element.set(attribute.name, self._value(kind, i, attribute, want, want))

    def _inertia(self, i: int, have: Any, want: Any) -> None:
        for compiler in (e for e in self.root.spliced() if e.tag == "compiler"):
            # Both would override the written values; their other effects are written in the next round.
            compiler.set("settotalmass", None)
            if compiler.get("inertiafromgeom") == "true":
                compiler.set("inertiafromgeom", "auto")
        body = self.find("body", i)
        mass, inertia, pos, quat = (getattr(want, f)[i] for f in tables.INERTIA_FIELDS)
        old = [getattr(have, f)[i] for f in tables.INERTIA_FIELDS]
        element = next((e for e in (*body.inside, *body.spliced()) if e.tag == "inertial"), None)
        if element is None:
            element = Element("inertial")
            body.inside.append(element)
            same = [False] * 4
        else:
            same = [
                np.allclose(a, b, rtol=SAME, atol=0.0)
                for a, b in zip((mass, inertia, pos, quat), old, strict=True)
            ]
        if not same[2]:
            self._set("body", i, element, "pos", numbers(pos), numbers(old[2]))
        if not same[0]:
            self._set("body", i, element, "mass", number(mass), number(old[0]))
        full = element.get("fullinertia")
        if full is not None and same[3] and not same[1] and np.ptp(inertia / old[1]) < SAME:
            scaled = np.array([float(v) for v in full.split()]) * np.mean(inertia / old[1])
            self._set("body", i, element, "fullinertia", numbers(scaled), full)
        elif not (same[1] and same[3]):
            self._set("body", i, element, "diaginertia", numbers(inertia), numbers(old[1]))
            if full is not None or not same[3]:
                for name in ("fullinertia", *tables.ORIENTATIONS):
                    element.set(name, None)
                if not np.array_equal(quat, [1, 0, 0, 0]):
                    element.set("quat", numbers(quat))

    def _gains(self, i: int, have: Any, want: Any) -> None:
        element = self.find("actuator", i)
        gain, bias = want.actuator_gainprm[i], want.actuator_biasprm[i]
        same = all(getattr(have, f)[i] == getattr(want, f)[i] for f in tables.TYPE_FIELDS)
        timed = have.actuator_dynprm[i, 0] != want.actuator_dynprm[i, 0]
        same = same and np.array_equal(have.actuator_dynprm[i, 1:], want.actuator_dynprm[i, 1:])
        position = np.array_equal(bias, np.append([0.0, -gain[0], bias[2]], np.zeros(len(bias) - 3)))
        plain = same and not gain[1:].any()
        if element.name == "position" and plain and position and bias[2] <= 0 <= gain[0]:
            self._set("actuator", i, element, "kp", number(gain[0]), number(have.actuator_gainprm[i, 0]))
            if timed:
                self._set(
                    "actuator",
                    i,
                    element,
                    "timeconst",
                    number(want.actuator_dynprm[i, 0]),
                    number(have.actuator_dynprm[i, 0]),
                )
            if bias[2] != have.actuator_biasprm[i, 2] or element.get("kv") is not None:
                self._set(
                    "actuator", i, element, "kv", number(-bias[2]), number(-have.actuator_biasprm[i, 2])
                )
                element.set("dampratio", None)
        elif (
            element.name == "velocity"
            and plain
            and not timed
            and np.array_equal(bias, np.append([0, 0, -gain[0]], bias[3:] * 0))
        ):
            self._set("actuator", i, element, "kv", number(gain[0]), number(have.actuator_gainprm[i, 0]))
        else:
            self._general(i, element, have, want)

    def _general(self, i: int, element: Element, have: Any, want: Any) -> None:
        if element.name not in ("general", "motor", "position", "velocity", "intvelocity", "damper"):
            raise ConfigurationError(
                f"{self._name('actuator', i)} is a <{element.name}>, whose gains cannot be written back; "
                "make it a <general> or a <position>"
            )
        if element.name != "general":
            element.rename = "general"
            for name in ("kp", "kv", "dampratio", "timeconst", "inheritrange"):
                element.set(name, None)
            for attribute in (a for a in tables.ACTUATOR if a.name.startswith("ctrl")):
                element.set(attribute.name, self._value("actuator", i, attribute, want, want))
            for name, words in tables.ACTUATOR_WORDS.items():
                element.set(name, self._word(i, name, words, want))
        for field in tables.GAIN_FIELDS:
            attribute = Attribute(field.removeprefix("actuator_"), (field,), trim=True)
            if element.rename or not np.array_equal(getattr(have, field)[i], getattr(want, field)[i]):
                self._write("actuator", "actuator", i, element, attribute, have, want)
        for name, words in tables.ACTUATOR_WORDS.items():
            if getattr(have, f"actuator_{name}")[i] != getattr(want, f"actuator_{name}")[i]:
                element.set(name, self._word(i, name, words, want))

    def _word(self, i: int, name: str, words: Sequence[str], want: Any) -> str:
        value = int(getattr(want, f"actuator_{name}")[i])
        if value >= len(words):
            raise ConfigurationError(
                f"{self._name('actuator', i)}: {name} number {value} cannot be written; allowed are "
                f"{', '.join(words)}"
            )
        return words[value]

    def _options(self, have: Any, want: Any) -> bool:
        changed = False
        for name in dir(have):
            a, b = getattr(have, name), getattr(want, name)
            if name.startswith("_") or callable(a) or np.array_equal(a, b):
                continue
            if name not in tables.OPTIONS:
                raise ConfigurationError(
                    f"option {name} differs in the calibrated model and cannot be written; options that can: "
                    f"{', '.join(tables.OPTIONS)}"
                )
            if self._option is None:
                there = [e for e in self.root.spliced() if e.tag == "option"]
                self._option = there[-1] if there else Element("option")
                if not there:
                    self.root.inside.append(self._option)
            words = tables.OPTION_WORDS.get(name)
            new, old = (words[int(v)] if words else numbers(np.atleast_1d(v)) for v in (b, a))
            self._option.set(name, new)
            self.log["option", "option", name] = (old, new)
            changed = True
        return changed


def _rows(masks: Mapping[str, Mask], fields: Iterable[str]) -> list[int]:
    found: set[int] = set()
    for field in fields:
        if field in masks:
            mask = masks[field]
            found.update(np.flatnonzero(mask.reshape(len(mask), -1).any(axis=1)).tolist())
    return sorted(found)


def _values(kind: str, i: int, attribute: Attribute, model: Any) -> npt.NDArray[np.float64]:
    if kind == "qpos":
        if _DOFS[int(model.jnt_type[i])] != 1:
            raise ConfigurationError(f"joint {i}: {attribute.name} of a free or ball joint cannot be written")
        return np.array([getattr(model, attribute.fields[0])[model.jnt_qposadr[i]]])
    if kind != "dof":
        rows = [np.ravel(getattr(model, f)[i]) for f in attribute.fields]
        return np.concatenate(rows).astype(float)
    first = int(model.jnt_dofadr[i])
    count = _DOFS[int(model.jnt_type[i])]
    every = [
        np.concatenate([np.ravel(getattr(model, f)[d]) for f in attribute.fields])
        for d in range(first, first + count)
    ]
    if any(not np.array_equal(row, every[0]) for row in every):
        raise ConfigurationError(
            f"joint {i}: {attribute.name} differs between its degrees of freedom, but an MJCF joint has one "
            "value for all"
        )
    return every[0].astype(float)


def _index(root: Element, model: Any) -> dict[str, list[Element | None]]:
    """Return the element of each compiled object: by name, or by order if all are written in the file."""
    written: dict[str, list[Element]] = {kind: [] for kind in _OBJECTS}
    for section in root.spliced():
        if section.tag == "worldbody":
            _body(section, written)
        elif section.tag in ("actuator", "tendon", "equality"):
            written[section.tag].extend(section.spliced())
        elif section.tag == "contact":
            written["pair"].extend(e for e in section.spliced() if e.tag == "pair")
    macro = any(e.tag in _MACROS for e in root.walk())
    found: dict[str, list[Element | None]] = {}
    for kind, (number_of, count) in _OBJECTS.items():
        size = int(getattr(model, count))
        names = [mujoco.mj_id2name(model, number_of, i) for i in range(size)]
        # The world is a body without an element of that kind.
        elements: list[Element | None] = [*([None] if kind == "body" else []), *written[kind]]
        own = [e.given.get("name") if e is not None else "world" for e in elements]
        ordered = (
            not macro
            and kind != "pair"
            and len(elements) == size
            and all((a or None) == (b or None) for a, b in zip(own, names, strict=True))
        )
        by_name = {name: e for name, e in zip(own, elements, strict=True) if name}
        found[kind] = elements if ordered else [by_name.get(name) if name else None for name in names]
    return found


def _body(element: Element, written: dict[str, list[Element]]) -> None:
    """Collect a body's own elements, then those of its child bodies: the compiler's order."""
    inner: list[Element] = []
    waiting = list(element.spliced())
    while waiting:
        child = waiting.pop(0)
        if child.tag == "frame":
            waiting[:0] = list(child.spliced())
        elif child.tag == "body":
            inner.append(child)
        elif child.tag in ("joint", "freejoint"):
            written["joint"].append(child)
        elif child.tag in ("geom", "site"):
            written[child.tag].append(child)
    for body in inner:
        written["body"].append(body)
        _body(body, written)
