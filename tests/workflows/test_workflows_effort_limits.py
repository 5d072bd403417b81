"""Drives at their effort limit: there the limit acts, and the dampings of drive and joint differ."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

SERVO = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="pole">
      <joint name="hub" axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="{armature}"/>
      <inertial pos="0 0 -0.2" mass="{mass}" diaginertia="1e-3 1e-3 1e-6"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="hub" kp="{kp}" kv="{kv}" forcerange="-{limit} {limit}"/></actuator>
</mujoco>"""
TRUE = {"damping": 0.05, "friction": 0.02, "armature": 0.004, "mass": 0.2, "kp": 8, "kv": 0.15, "limit": 1}
OWNED = TRUE | {"damping": 0.02, "friction": 0.04, "armature": 0.006, "kp": 6, "kv": 0.25, "limit": 1.1}
"""The owner's file."""
LIMITED = {"drive.servo_effort_limit", "drive.servo_damping", "hub.damping"}
NAMES = {
    "hub.damping": "damping",
    "hub.frictionloss": "friction",
    "hub.armature": "armature",
    "pole.mass": "mass",
    "drive.servo_stiffness": "kp",
    "drive.servo_damping": "kv",
    "drive.servo_effort_limit": "limit",
}


def recording(amplitude: float, seed: int, seconds: float = 8.0) -> dict[str, FloatArray]:
    """Return 100 Hz of the real servo at random set-points, held for 0.3 s, with noise of 0.5 mrad."""
    model = mujoco.MjModel.from_xml_string(SERVO.format(**TRUE))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.01)
    target = np.repeat(amplitude * rng.uniform(-1, 1, time.size // 30 + 1), 30)[: time.size]
    target[:30] = 0.0
    seen = np.empty(time.size)
    for k, wanted in enumerate(target):
        seen[k] = data.qpos[0]
        data.ctrl[0] = wanted
        mujoco.mj_step(model, data, 5)
    return {"time": time, "hub_pos": seen + 5e-4 * rng.standard_normal(time.size), "hub_cmd": target}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The owner's model."""
    path = tmp_path_factory.mktemp("servo") / "servo.xml"
    path.write_text(SERVO.format(**OWNED))
    return path


def test_what_shows_at_a_limit_is_searched_where_it_is_reached(model: Path) -> None:
    """Else the larger one of two dampings that add up; a value that is named stays."""
    asks = {a: [recording(a, seed) for seed in (0, 1)] for a in (0.06, 1.0)}
    for amplitude, names in ((0.06, {"drive.servo_damping"}), (1.0, LIMITED)):
        work = calibration_input(FilesSettings(model, asks[amplitude][0], holdout=asks[amplitude][1]))
        assert set(work.space.names) & LIMITED == names
    known = FilesSettings(
        model, asks[0.06][0], holdout=asks[0.06][1], known={"drive.servo_effort_limit": 1.0}
    )
    assert calibration_input(known).space.known == {"drive.servo_effort_limit": 1.0}


@pytest.mark.parametrize("by_file", [False, True])
def test_a_servo_at_its_limit_is_found(model: Path, by_file: bool, tmp_path: Path) -> None:
    """By default, and with a file that leaves out the joint's damping: that is the first that is tried.

    The common scale is what was expected of mass and limit. With the file the limit holds it, 10 % too high.
    """
    text = (
        "parameters:\n"
        + "".join(
            f"  - {{kind: {kind}, elements: {of}}}\n"
            for kind, of in (
                ("dof_frictionloss", "hub"),
                ("dof_armature", "hub"),
                ("servo_stiffness", "drive"),
                ("servo_damping", "drive"),
            )
        )
        + "  - {kind: body_mass, elements: pole, prior: {mean: 0.2, std: 0.06}}\n"
    )
    path = tmp_path / "params.yaml"
    path.write_text(text)
    found = deal_hw.calibrate(
        model,
        [recording(1.0, seed) for seed in (0, 1)],
        holdout=recording(1.0, 2),
        **({"parameters": path} if by_file else {}),
    )
    result = found.result
    assert found.colour == "green", result.alarms
    assert set(result.space.names) & LIMITED == (
        LIMITED - {"drive.servo_effort_limit"} if by_file else LIMITED
    )
    assert result.chi2 < 1.1
    scale = OWNED["limit"] / TRUE["limit"] if by_file else 1.0
    names = [name for name in result.space.names if name in NAMES]
    ratio = np.array([result.estimate[result.space.names.index(n)] / TRUE[NAMES[n]] for n in names])
    assert ratio / np.median(ratio) == pytest.approx(1.0, rel=0.05)
    for name in names:
        low, high = result.interval[result.space.names.index(name)]
        assert low <= scale * TRUE[NAMES[name]] <= high, name


def test_green_is_not_said_where_held_out_motion_does_more(model: Path) -> None:
    """Small motions are explained to the noise; a large one reaches a limit that is not the file's."""
    fitted = [recording(0.06, seed) for seed in (0, 1)]
    for amplitude in (0.06, 1.0):
        found = deal_hw.calibrate(model, fitted, holdout=recording(amplitude, 2))
        assert found.result.chi2 < 1.1
        heldout = found.result.provenance["heldout_chi2"]
        assert (found.colour == "green" and heldout < 1.2) if amplitude < 0.1 else heldout > 4
    assert found.colour != "green"
    (alarm,) = found.result.alarms
    assert "On held-out motion the error is" in alarm.seen and "--data" in alarm.do


def test_a_joint_limit_of_a_motor_is_searched_where_commands_reach_it(tmp_path: Path) -> None:
    """By efforts at the joint: 0.9 N·m of commands do not reach 1 N·m of actuatorfrcrange, 1.2 N·m do."""
    text = SERVO.format(**TRUE).replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="-1 1"')
    start, _, end = text.partition("<position")
    model = tmp_path / "motor.xml"
    model.write_text(f'{start}<motor name="drive" joint="hub" gear="3"/>{end.partition("/>")[2]}')
    signs = np.random.default_rng(1).choice([-1, 0, 1], 40)
    for most, found in ((0.9, False), (1.2, True)):
        compiled = mujoco.MjModel.from_xml_path(str(model))
        data, rows = mujoco.MjData(compiled), []
        for k in range(400):
            effort = most * signs[k // 10]
            rows.append((0.01 * k, data.qpos[0], effort))
            data.ctrl[0] = effort / 3
            mujoco.mj_step(compiled, data, 5)
        columns = dict(zip(("time", "hub_pos", "hub_cmd"), np.array(rows).T, strict=True))
        columns["hub_pos"] = columns["hub_pos"] + 5e-4 * np.random.default_rng(0).standard_normal(400)
        work = calibration_input(FilesSettings(model, columns, force=True))
        assert ("drive.servo_effort_limit" in work.space.names) == found
