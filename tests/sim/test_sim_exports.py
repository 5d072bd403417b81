"""Calibrated values as other programs take them, and what each cannot hold."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from deal_hw.calibration import CalibrationResult
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.bam import bam_parameters
from deal_hw.sim.mjcf.calibrated import WITHOUT_VALUE_TEXT, write_calibrated_mjcf
from deal_hw.sim.mjcf.exports import actuator_tables, plain_values, urdf_values, write_exports

MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.01" frictionloss="0.1" range="-2 2"
      limited="true"/>
      <inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.03 0.01" euler="0 0 1.5707963267948966"/>
      <body pos="0 0 0.2"><joint name="elbow" axis="0 1 0"/><geom size="0.05"/></body>
    </body>
  </worldbody>
  <actuator>
    <position name="m1" joint="shoulder" kp="10" kv="1" gear="3" forcerange="-4 4" forcelimited="true"/>
    <motor name="m2" joint="elbow" gear="2" ctrlrange="-5 5" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


def parameter(name: str, kind: str, element: str, unit: str, nominal: float, **more: Any) -> Parameter:
    """Return a parameter of one element."""
    return Parameter(
        name=name,
        kind=kind,
        elements=(element,),
        unit=unit,
        nominal=nominal,
        low=nominal / 5,
        high=nominal * 5,
        **more,
    )


@pytest.fixture
def robot(tmp_path: Path) -> RobotModel:
    """Two joints: a geared position servo and a motor."""
    path = tmp_path / "arm.xml"
    path.write_text(MODEL)
    description = dataclasses.replace(
        DESCRIPTION,
        name="arm",
        mjcf=path,
        joint_names=("shoulder", "elbow"),
        actuated=("shoulder", "elbow"),
        position_units=("rad", "rad"),
        stiffness=(10.0, 0.0),
        damping=(1.0, 0.0),
        effort_limit=(4.0, 5.0),
        speed_limit=(np.inf, np.inf),
        device_rate_hz=500.0,
        state_rate_hz=500.0,
        limits=dataclasses.replace(
            DESCRIPTION.limits,
            **{
                name: getattr(DESCRIPTION.limits, name) * (2 // len(getattr(DESCRIPTION.limits, name)))
                for name in (f.name for f in dataclasses.fields(DESCRIPTION.limits))
                if isinstance(getattr(DESCRIPTION.limits, name), tuple) and getattr(DESCRIPTION.limits, name)
            },
        ),
    )
    return load_model(description)


@pytest.fixture
def result() -> CalibrationResult:
    """Five parameters, one of them without a value."""
    space = ParameterSpace(
        [
            parameter("shoulder.stiffness", "servo_stiffness", "m1", "N·m/rad", 10.0),
            parameter("shoulder.armature", "dof_armature", "shoulder", "kg·m²", 0.01),
            parameter("m1.delay", "command_delay", "m1", "s", 0.004, known=True),
            parameter("upper.mass", "body_mass", "upper", "kg", 2.0),
            parameter("elbow.bias", "encoder_bias", "elbow", "rad", 0.02),
        ]
    )
    estimate = np.array([20.0, 0.03, 4.0, 0.05])
    return CalibrationResult(
        method="test",
        space=space,
        estimate=estimate,
        interval=np.stack([0.9 * estimate, 1.1 * estimate], axis=1),
        verdicts=("identifiable", "not identifiable", "identifiable", "weak"),
        latency_s=0.0125,
        latency_interval_s=(0.011, 0.0145),
    )


def test_actuator_table_by_hand(robot: RobotModel, result: CalibrationResult) -> None:
    """Gears are squared in gains and once in limits; parameters are the joint's; delays are whole steps."""
    table = actuator_tables(robot, result)
    isaac = table["isaac_lab"]
    # kp 20; kv 1 * 3^2 and the joint's own 0.2; 4 * 3; motor: 5 * 2.
    assert isaac["stiffness"] == {"shoulder": pytest.approx(20.0)}
    assert isaac["damping"] == {"shoulder": pytest.approx(9.2)}
    assert isaac["armature"]["shoulder"] == pytest.approx(0.03)
    assert isaac["friction"] == {"shoulder": 0.1, "elbow": 0.0}
    assert isaac["effort_limit"] == {"shoulder": 12.0, "elbow": 10.0}
    assert isaac["velocity_limit"] == {}
    # 11 to 14.5 ms at 2 ms a step.
    assert (isaac["min_delay"], isaac["max_delay"]) == (5, 8)
    assert table["delay_s"] == {"shoulder": pytest.approx(0.0165), "elbow": pytest.approx(0.0125)}
    assert table["without_value"] == {"shoulder": ["armature"]}
    first = table["mjlab"]["actuators"][0]
    assert first["damping"] == 9.0 and first["target_names_expr"] == ["shoulder"]
    assert first["viscous_damping"] == 0.2 and table["mjlab"]["actuators"][1]["viscous_damping"] == 0.0
    # 12.5 ms and the 4 ms of its own, at 2 ms a step: 8.25; without its own 6.25.
    assert [row["delay_max_lag"] for row in table["mjlab"]["actuators"]] == [8, 6]
    for part in (isaac, table["mjlab"]):
        assert any("elbow.bias = 0.05 rad" in text for text in part["cannot_express"])
        assert not any("shoulder.stiffness" in text for text in part["cannot_express"])


def test_armature_and_damping_of_an_actuator_count(robot: RobotModel, result: CalibrationResult) -> None:
    """They act on the joint as its own do, times the gear squared: MuJoCo's mass matrix is the judge."""
    model = robot.model
    before = model.dof_M0[robot.qvel[0]]
    model.actuator_armature[0], model.actuator_damping[0] = 0.5, 0.1
    mujoco.mj_setConst(model, mujoco.MjData(model))
    added = model.dof_M0[robot.qvel[0]] - before
    isaac = actuator_tables(robot, result)["isaac_lab"]
    assert isaac["armature"]["shoulder"] == pytest.approx(0.03 + added) == pytest.approx(0.03 + 0.5 * 3**2)
    # kv 1 * 3^2, the joint's own 0.2, the actuator's 0.1 * 3^2.
    assert isaac["damping"]["shoulder"] == pytest.approx(10.1)
    dynamics = urdf_values(robot, result)["joints"]["shoulder"]["dynamics"]
    assert dynamics == {"damping": pytest.approx(1.1), "friction": 0.1}


def test_urdf_side_by_hand(robot: RobotModel, result: CalibrationResult) -> None:
    """Inertia scales with the mass and is turned into the link's frame; gains have no place."""
    values = urdf_values(robot, result)
    shoulder = values["joints"]["shoulder"]
    assert shoulder["dynamics"] == {"damping": 0.2, "friction": 0.1}
    assert shoulder["limit"] == {"lower": -2.0, "upper": 2.0, "effort": 12.0, "velocity": None}
    link = values["links"]["upper"]
    assert link["mass"] == 4.0 and link["origin_xyz"] == [0.0, 0.0, 0.1]
    # Twice the mass is twice the inertia; a quarter turn about z swaps x and y.
    inertia = {name: pytest.approx(value, abs=1e-12) for name, value in link["inertia"].items()}
    assert inertia == {"ixx": 0.06, "ixy": 0.0, "ixz": 0.0, "iyy": 0.04, "iyz": 0.0, "izz": 0.02}
    assert values["without_value"] == ["shoulder.armature"]
    assert any("shoulder.stiffness = 20 N·m/rad" in text for text in values["cannot_express"])


def test_plain_values_have_none_where_there_is_none(result: CalibrationResult) -> None:
    """A number that nobody measured must not be read as one."""
    values = plain_values(result)
    assert values["parameters"]["shoulder.armature"]["value"] is None
    assert values["parameters"]["upper.mass"] == {
        "kind": "body_mass",
        "elements": ["upper"],
        "unit": "kg",
        "value": 4.0,
        "interval": [3.6, 4.4],
        "nominal": 2.0,
        "biased_by": None,
    }
    assert values["known"] == {"m1.delay": 0.004} and values["latency"]["value"] == 0.0125


def test_files_are_yaml(robot: RobotModel, result: CalibrationResult, tmp_path: Path) -> None:
    """What is written reads back with any YAML reader, numbers as numbers."""
    names = write_exports(tmp_path, robot, result)
    assert names == ["actuators.yaml", "urdf.yaml", "values.yaml", "bam.json"]
    tables = (actuator_tables(robot, result), urdf_values(robot, result), plain_values(result))
    for name, wanted in zip(names, (*tables, bam_parameters(robot, result)), strict=True):
        found = yaml.safe_load((tmp_path / name).read_text(encoding="utf-8"))
        assert found == wanted | {"alarms": [], "biased": {}}


def test_verdict_alarms_and_biased_values_stand_in_each_file(
    robot: RobotModel, result: CalibrationResult, tmp_path: Path
) -> None:
    """Whoever takes a value into another program sees that a named cause moved it."""
    doubtful = dataclasses.replace(
        result,
        alarms=(Finding.alarm("0.25 kg at the tip.", "Another mass.", "Weigh it."),),
        biased={"shoulder.stiffness": "mass", "latency": "mass"},
    )
    for name in write_exports(tmp_path, robot, doubtful, {"verdict": "amber", "verdict_reason": "because"}):
        found = yaml.safe_load((tmp_path / name).read_text(encoding="utf-8"))
        assert found["verdict"] == "amber" and found["verdict_reason"] == "because"
        assert found["alarms"] == ["0.25 kg at the tip."]
        assert found["biased"] == {"shoulder.stiffness": "mass", "latency": "mass"}
    assert plain_values(doubtful)["parameters"]["shoulder.stiffness"]["biased_by"] == "mass"
    path = tmp_path / "calibrated.xml"
    write_calibrated_mjcf(
        robot, result.space, result.estimate, path, 0.01, verdict="amber", biased=doubtful.biased
    )
    text = path.read_text(encoding="utf-8")
    assert "verdict: amber" in text and "biased by mass: shoulder.stiffness" in text
    assert '<text name="deal_hw.verdict" data="amber"/>' in text
    assert '<text name="deal_hw.biased" data="shoulder.stiffness latency"/>' in text


def test_parameters_without_a_value_are_marked_in_the_model(
    robot: RobotModel, result: CalibrationResult, tmp_path: Path
) -> None:
    """By name at the top and in <custom>; calibrating that file again replaces the list."""

    def marked(source: RobotModel, target: Path, names: tuple[str, ...]) -> str:
        write_calibrated_mjcf(source, result.space, result.estimate, target, 0.01, "test", names)
        model = mujoco.MjModel.from_xml_path(str(target))
        found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, WITHOUT_VALUE_TEXT)
        begin = model.text_adr[found]
        return bytes(model.text_data[begin : begin + model.text_size[found]]).rstrip(b"\0").decode()

    first = tmp_path / "first.xml"
    assert marked(robot, first, result.without_value) == "shoulder.armature"
    assert "no value: shoulder.armature; 0.03 kg·m² stands here" in first.read_text(encoding="utf-8")
    again = load_model(dataclasses.replace(robot.description, mjcf=first))
    assert marked(again, tmp_path / "second.xml", ()) == "none"
