"""Three small robots for tests of laws, and batches of them with known parameters."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import Sampling, describe
from deal_hw.types import FloatArray

SERVO = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="0.05" frictionloss="0.1" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/>
<body pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping="0.05" frictionloss="0.05" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3"/></body></body>
</worldbody><actuator>
<position name="shoulder" joint="shoulder" kp="20" kv="1" forcerange="-4 4"/>
<position name="elbow" joint="elbow" kp="10" kv="0.5" forcerange="-3 3"/>
</actuator></mujoco>"""

MOTOR = """
<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<body><joint name="wheel" axis="0 1 0" armature="0.01"/><geom type="cylinder" size=".1 .02" mass=".5"/></body>
</worldbody><actuator>
<motor name="wheel" joint="wheel" gear="2" ctrlrange="-1 1" forcerange="-.5 .5"/></actuator>
</mujoco>"""

GEARED = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="0.3" frictionloss="0.05" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/></body>
</worldbody><actuator>
<general name="shoulder" joint="shoulder" gear="-2" ctrlrange="-1 .8" forcerange="-1.5 1.5" gainprm="3"
 biastype="affine" biasprm=".1 -6"/>
</actuator></mujoco>"""
"""A servo behind a gear that turns the other way; its set-point is scaled and limited, an effort constant."""


def robot(tmp_path: Path, text: str) -> RobotModel:
    """Return the model of a text."""
    path = tmp_path / "robot.xml"
    path.write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    driven = [model.joint(int(j)).name for j in model.actuator_trnid[:, 0]]
    rates = Sampling(period_s=0.002, substeps=1, samples_per_tick=10)
    return load_model(describe(path, model, driven, driven, rates))


def known(kind: str, element: str, value: float, name: str = "") -> Parameter:
    """Return a parameter that is not searched."""
    return Parameter(
        name=name or f"{element}.{kind}",
        kind=kind,
        elements=(element,),
        unit="-",
        nominal=value,
        low=value - 1.0,
        high=value + 1.0,
        scale="linear",
        known=True,
    )


def batch(model: RobotModel, *parameters: Parameter, count: int = 1) -> ServoBatch:
    """Return members with known parameters, and one that is searched, at its nominal value."""
    joint = model.description.joint_names[0]
    own = float(model.model.dof_damping[model.model.joint(joint).dofadr[0]])
    free = Parameter(
        name="free", kind="dof_damping", elements=(joint,), unit="-", nominal=own, low=own - 1, high=own + 1,
        scale="linear",
    )  # fmt: skip
    return ServoBatch(model, ParameterSpace([free, *parameters]), count, threads=1)


def swing(steps: int, width: int) -> FloatArray:
    """Return set-points that move through both directions, (1, S, A)."""
    time = np.arange(steps) * 0.002
    return np.stack([0.6 * np.sin(2 * np.pi * (0.7 + 0.4 * k) * time) for k in range(width)], axis=1)[None]


def moved(model: mujoco.MjModel, commands: FloatArray, start: FloatArray) -> FloatArray:
    """Return reported positions after each step of commands in a loop with the laws, (S, J)."""
    data = mujoco.MjData(model)
    data.qpos[:] = start
    laws = ActuatorLaws(model, data)
    laws.restart(commands[0])
    found = []
    for command in commands:
        laws.step(command)
        found.append(laws.reported())
    return np.array(found)
