"""The calibrated model as a change of the user's own MJCF, with the user's text, includes and meshes.

Only attributes with a changed value are edited; see :mod:`deal_hw.sim.mjcf.text`.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, short
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import COMMAND_DELAY
from deal_hw.sim.engine.model import RobotModel, model_with
from deal_hw.sim.mjcf import tables
from deal_hw.sim.mjcf.changes import SAME, MjcfChanges, NotInTextError, differences, numbers
from deal_hw.sim.mjcf.flat import ROUNDED, write_flat
from deal_hw.sim.mjcf.paths import Relocation
from deal_hw.sim.mjcf.text import Element, SourceFile, read_files
from deal_hw.sim.parameters import DEVICE_KINDS, check_kinds
from deal_hw.sim.parameters.drive import filtered
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.parameters.one_drive import scatter
from deal_hw.types import FloatArray

SPEED_LIMIT_NUMERIC = "deal_hw.speed_limit"
LATENCY_NUMERIC = "deal_hw.latency_s"
WITHOUT_VALUE_TEXT = "deal_hw.without_value"
VERDICT_TEXT = "deal_hw.verdict"
BIASED_TEXT = "deal_hw.biased"

ROUNDS = 4
"""Most rounds of writing. Writing one value may disable another one of the compiler (``dampratio``,
``settotalmass``); the next round writes the resulting difference."""

_CHECK, _CHECK_ZERO = 1e-9, 1e-12
_CHECK_DERIVED = 1e-5


def write_calibrated_mjcf(
    robot: RobotModel,
    space: ParameterSpace,
    theta: FloatArray,
    path: Path,
    latency_s: float,
    source: str = "",
    without_value: Sequence[str] = (),
    verdict: str = "",
    biased: Mapping[str, str] | None = None,
) -> tuple[Path, ...]:
    """Write the robot's MJCF with calibrated values.

    Unidentified parameters are marked. The comment at the top names them with the values in the file, and
    ``<custom>`` lists them in the ``<text>`` :data:`WITHOUT_VALUE_TEXT`. Values without a MuJoCo field go
    into ``<custom>``, too. The latency is ``deal_hw.latency_s``. Each kind of parameter outside MuJoCo (speed
    limit, encoder bias) has one number per element, beside a ``<text>`` of the same name that lists the
    elements. The verdict and the biased values are marked like unidentified parameters, in the comment and in
    the ``<text>`` of :data:`VERDICT_TEXT` and :data:`BIASED_TEXT`.

    Args:
        robot: The robot's model.
        space: The parameters.
        theta: Calibrated values, (K,).
        path: File to write; changed included files are written beside it.
        latency_s: Total latency [s].
        source: Source of the values, for the comment at the top.
        without_value: Names of the unidentified parameters.
        verdict: The calibration's verdict: green, amber or red; "" if there is none.
        biased: Cause of the residual that a value compensates for, by the value's name.

    Returns:
        The files written, ``path`` first.

    Raises:
        ConfigurationError: A value has no place in MJCF, or the written file does not compile to the
            calibrated model.
    """
    check_kinds(space)
    values = dict(zip(space.names, theta, strict=True))
    biased = biased or {}
    remarks = [
        *([f"verdict: {verdict}"] if verdict else ()),
        *(f"no value: {name}; {values[name]:.5g} {space[name].unit} stands here" for name in without_value),
        *(f"biased by {cause}: {name}" for name, cause in biased.items()),
    ]
    model = model_with(robot, space, theta)
    lags = _write_lags(model, space, theta)
    model.actuator_delay[:] = 0.0
    scatter(model, mujoco.MjModel.from_xml_path(os.path.abspath(robot.description.mjcf)))
    return change_mjcf(
        robot.description.mjcf,
        path,
        model,
        _with_own_delays(robot, device_values(space, theta, lags)) | {LATENCY_NUMERIC: ([latency_s], [])},
        source,
        # A file that was calibrated before may have a list: it is replaced, also by "none".
        {
            WITHOUT_VALUE_TEXT: " ".join(without_value) or "none",
            VERDICT_TEXT: verdict or "none",
            BIASED_TEXT: " ".join(biased) or "none",
        },
        remarks,
    )


def custom_name(kind: str) -> str:
    """Return the name under which ``<custom>`` has the values of a kind without a MuJoCo field."""
    return f"deal_hw.{kind.removeprefix('servo_')}"


def _write_lags(model: Any, space: ParameterSpace, theta: FloatArray) -> set[str]:
    """Write lags of actuators with a filter into that; return their names. Other lags have no field."""
    values, found = dict(zip(space.names, theta, strict=True)) | space.known, set()
    for parameter in space.parameters:
        for name in parameter.elements if parameter.kind == "command_lag" else ():
            actuator = element_id(model, "actuator", name)
            if filtered(model, actuator):
                model.actuator_dynprm[actuator, 0] = values[parameter.name]
                found.add(name)
    return found


def _with_own_delays(
    robot: RobotModel, device: dict[str, tuple[list[float], list[str]]]
) -> dict[str, tuple[list[float], list[str]]]:
    """Return values without a MuJoCo field, with delays beyond the latency that stay those of the MJCF."""
    delays, elements = device.get(custom_name(COMMAND_DELAY), ([], []))
    for name, delay_s in zip(robot.actuator_names, robot.command_delay_s, strict=True):
        if delay_s and name not in elements:
            delays, elements = [*delays, float(delay_s)], [*elements, name]
    return device | ({custom_name(COMMAND_DELAY): (delays, elements)} if elements else {})


def custom_latency_s(model: Any) -> float:
    """Return the latency in ``<custom>`` [s]; 0 where there is none."""
    return next(iter(_numeric(model, LATENCY_NUMERIC)), 0.0)


def custom_values(model: Any, name: str) -> dict[str, float]:
    """Return the values of a list in ``<custom>`` by element; none where there is no list.

    Raises:
        ConfigurationError: It has more values than elements, or fewer.
    """
    values = _numeric(model, name)
    if not values:
        return {}
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, f"{name}.elements")
    text = bytes(model.text_data[model.text_adr[k] :][: model.text_size[k]]) if k >= 0 else b""
    names = text.rstrip(b"\0").decode().split()
    if len(names) != len(values):
        raise ConfigurationError(
            f"<custom>: {name} has {len(values)} values and {len(names)} elements; write the file again with "
            "deal-hw calibrate"
        )
    return dict(zip(names, values, strict=True))


def _numeric(model: Any, name: str) -> list[float]:
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if k < 0:
        return []
    values: list[float] = model.numeric(k).data.tolist()
    return values


def device_values(
    space: ParameterSpace, theta: FloatArray, filters: Collection[str] = ()
) -> dict[str, tuple[list[float], list[str]]]:
    """Return values without a MuJoCo field, by their name in ``<custom>``: values and elements.

    Args:
        space: The parameters.
        theta: Their values, (K,).
        filters: Actuators whose lag is that of their filter in the MJCF.
    """
    values = dict(zip(space.names, np.asarray(theta, dtype=float), strict=True)) | space.known
    found: dict[str, tuple[list[float], list[str]]] = {}
    for parameter in space.parameters:
        native = filters if parameter.kind == "command_lag" else ()
        if parameter.kind in DEVICE_KINDS and not set(parameter.elements) <= set(native):
            data, elements = found.setdefault(custom_name(parameter.kind), ([], []))
            for element in (e for e in parameter.elements if e not in native):
                data.append(float(values[parameter.name]))
                elements.append(element)
    return found


def change_mjcf(
    path: Path,
    target: Path,
    want: Any,
    custom: Mapping[str, tuple[Sequence[float], Sequence[str]]],
    source: str = "",
    texts: Mapping[str, str] | None = None,
    remarks: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Write an MJCF so that it compiles to another model.

    Args:
        path: The user's file.
        target: The file to write.
        want: The wanted MjModel; it has the same elements as the file's.
        custom: Numbers for ``<custom>`` and their elements, by name.
        source: For the comment at the top.
        texts: Texts for ``<custom>``, by name.
        remarks: More lines for that comment.

    Returns:
        The files written, ``target`` first.

    Raises:
        ConfigurationError: As :func:`write_calibrated_mjcf`.
    """
    require_other(target, path)

    def write(file: Path, rounded: float, *more: str) -> tuple[Path, ...]:
        return _write(file, target, want, custom, texts or {}, (path.name, source, *more, *remarks), rounded)

    try:
        return write(path, SAME)
    except NotInTextError:
        # Beside the target, as both name meshes and textures from there.
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=".flat-", suffix=".xml") as waiting:
            flat = Path(waiting.name)
            write_flat(path, flat)
            return write(flat, ROUNDED, "written out in full, as other models or macros made it")


def _write(
    path: Path,
    target: Path,
    want: Any,
    custom: Mapping[str, tuple[Sequence[float], Sequence[str]]],
    texts: Mapping[str, str],
    words: Sequence[str],
    rounded: float,
) -> tuple[Path, ...]:
    """Write a file's text with changes; see :func:`change_mjcf`.

    Args:
        path: The file.
        target: The file to write.
        want: The wanted model.
        custom: Numbers for ``<custom>``.
        texts: Texts for ``<custom>``.
        words: Name of the user's file, source of the values, and more lines for the comment at the top.
        rounded: Relative error of the file's numbers.
    """
    top = read_files(path)
    spec = mujoco.MjSpec.from_file(str(top.path))
    have = spec.compile()
    changes = MjcfChanges(top.root, have, bool(spec.compiler.degree), rounded)
    relocation = Relocation(top, target)
    relocation.adapt()
    _set_custom(top.root, custom, texts)
    written: dict[Path, SourceFile] = {}
    try:
        for _ in range(ROUNDS):
            open_ = changes.apply(have, want)
            top.header = _header(changes, custom, *words)
            written = relocation.files()
            for file, content in written.items():
                file.write_bytes(content.render())
            if not open_:
                break
            have = compiled(target)
        _check(target, have, want, rounded)
    except (ConfigurationError, OSError):
        for file in written:
            file.unlink(missing_ok=True)
        raise
    return tuple(sorted(written, key=lambda file: file.name != target.name))


def require_other(target: Path, path: Path) -> None:
    """Check that a file to write is not the model itself.

    Raises:
        ConfigurationError: It is.
    """
    if target.exists() and target.samefile(path):
        raise ConfigurationError(f"{target} is the model itself; write the calibrated one to another file")


def compiled(path: Path) -> Any:
    """Return a written model.

    Raises:
        ConfigurationError: It does not compile.
    """
    try:
        # MuJoCo finds files of included files differently for absolute and relative paths.
        return mujoco.MjModel.from_xml_path(os.path.abspath(path))
    except (ValueError, mujoco.FatalError) as err:
        raise ConfigurationError(
            f"the calibrated model {path} does not compile: {short(str(err))}; the values are in "
            "result.json beside it"
        ) from err


def _check(path: Path, written: Any, want: Any, rounded: float) -> None:
    # A file of rounded numbers is as near as these are.
    wrong = differences(written, want, max(_CHECK, rounded), max(_CHECK_ZERO, rounded))
    derived = max(_CHECK_DERIVED, 10 * rounded)
    for name in tables.FOLLOWS:
        have, wish = getattr(written, name), getattr(want, name)
        if not np.allclose(have, wish, rtol=derived, atol=1e-9):
            wrong[name] = ~np.isclose(have, wish, rtol=derived, atol=1e-9)
    for name, mask in wrong.items():
        have, wish = getattr(written, name)[mask], getattr(want, name)[mask]
        raise ConfigurationError(f"{path}: {name} came out as {have.tolist()}, expected {wish.tolist()}")


def _header(
    changes: MjcfChanges,
    custom: Mapping[str, tuple[Sequence[float], Sequence[str]]],
    name: str,
    source: str,
    *remarks: str,
) -> str:
    lines = [f"Calibrated by deal-hw{': ' + source if source else ''}. A change of {name}:"]
    for (_, element, attribute), (old, new) in changes.log.items():
        lines.append(f"  {element}: {attribute} {_short(old)} -> {_short(new)}")
    for name, (data, elements) in custom.items():
        of = f" of {', '.join(elements)}" if elements else ""
        lines.append(f"  custom: {name} {_short(numbers(data))}{of}")
    return "\n".join([*lines, *(f"  {remark}" for remark in remarks), ""])


def _short(values: str) -> str:
    """Round an attribute's numbers for reading; the attribute itself has all digits."""
    try:
        return " ".join(f"{float(v):.5g}" for v in values.split())
    except ValueError:
        return values


def _set_custom(
    root: Element, custom: Mapping[str, tuple[Sequence[float], Sequence[str]]], texts: Mapping[str, str]
) -> None:
    section = Element("custom")
    wanted = [("text", name, {"data": text}) for name, text in texts.items()]
    for name, (data, elements) in custom.items():
        wanted.append(("numeric", name, {"size": str(len(data)), "data": numbers(data)}))
        if elements:
            wanted.append(("text", f"{name}.elements", {"data": " ".join(elements)}))
    for tag, full_name, attributes in wanted:
        # A file that was calibrated before has them already.
        there = [e for e in root.walk() if e.tag == tag and e.get("name") == full_name]
        element = there[0] if there else Element(tag)
        if not there:
            section.last.append(element)
            element.set("name", full_name)
        for key, value in attributes.items():
            element.set(key, value)
    if section.last:
        root.last.append(section)
