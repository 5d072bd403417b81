"""What of a model has no effect is said; what needs no reading is no reason to refuse it."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.mjcf.joint_facts import joint_facts
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.workflows.import_export import ImportSettings, import_recordings

ARM = """<mujoco>
  <option timestep="0.002" {option}>{flags}</option>
  <worldbody><body name="arm">
    <joint name="hub" axis="0 1 0" damping="0.1" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>{child}
  </body></worldbody>
  <actuator>{actuator}{more}</actuator>
</mujoco>"""
SERVO = '<position name="p" joint="hub" kp="40" kv="1"/>'
BALL = (
    '<body pos="0 0 -.3"><joint name="ball" type="ball"/><geom size=".02" mass=".05" pos="0 0 -.05"/></body>'
)
ADHESION = '<adhesion name="grip" body="arm" ctrlrange="0 1" gain="1"/>'


def write(folder: Path, actuator: str = SERVO, **parts: str) -> Path:
    """Write an arm."""
    path = folder / "arm.xml"
    path.write_text(
        ARM.format(**{"option": "", "flags": "", "child": "", "more": ""} | parts, actuator=actuator)
    )
    return path


def robot(path: Path) -> RobotModel:
    """Return the robot of a model with one recorded joint."""
    return load_model(describe(path, compile_mjcf(path), ["hub"], ["hub"], sampling(0.01, 0.002, 0.2)))


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"flags": '<flag gravity="disable" frictionloss="disable"/>'}, "gravity, frictionloss.*void"),
        ({"option": 'actuatorgroupdisable="0 3"'}, "actuators p .*void"),
        ({"option": 'actuatorgroupdisable="1"'}, ""),
        ({"flags": '<flag contact="disable"/>'}, ""),
        ({"more": ADHESION}, "left out: grip"),
        ({"child": BALL}, "no reading: ball.*at rest"),
        ({}, ""),
    ],
)
def test_what_is_said_at_import(parts: dict[str, str], said: str, tmp_path: Path) -> None:
    """A sentence each, none where nothing is void; the import goes on."""
    path, printed = write(tmp_path, **parts), list[str]()
    facts = joint_facts(path)
    assert len(facts.notes) == (1 if said else 0)
    time = 0.01 * np.arange(400)
    target, rng = 0.5 * np.sin(3 * time), np.random.default_rng(0)
    table = np.stack([time, 0.9 * target + 1e-3 * rng.standard_normal(400), target], axis=1)
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="time,hub_pos,hub_cmd", comments="")
    import_recordings(
        ImportSettings(paths=(tmp_path / "r.csv",), model=path, out=tmp_path / "set", force=True),
        say=printed.append,
    )
    assert [line for line in printed if line.startswith("arm.xml: ")][-1:] == [
        f"arm.xml: {note}" for note in facts.notes
    ]
    if said:
        assert re.search(said, facts.notes[0])


def test_a_ball_joint_begins_at_rest_and_moves(tmp_path: Path) -> None:
    """Each window begins in the model's pose, whatever the one before left; MuJoCo alone agrees."""
    one = robot(write(tmp_path, child=BALL))
    batch = ServoBatch(one, default_space(one.model), 1, threads=1)
    found = []
    for _ in range(2):
        batch.set_state(np.array([0.3]), np.array([1.0]))
        found.append(batch.advance(np.full((1, 200, 1), -0.5), every=10)[0][0, :, 0])
    assert np.array_equal(found[0], found[1])
    model = mujoco.MjModel.from_xml_path(str(one.description.mjcf))
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, 1.0, -0.5
    mujoco.mj_step(model, data, 200)
    assert abs(data.qpos[1]) < 0.999
    assert found[0][-1] == pytest.approx(data.qpos[0], abs=1e-9)


def test_laws_act_beside_an_adhesion(tmp_path: Path) -> None:
    """It drives body 1, and the model has one joint: the servo's laws act as without it."""
    ends = []
    for more in ("", ADHESION):
        model = mujoco.MjModel.from_xml_path(str(write(tmp_path, more=more)))
        data = mujoco.MjData(model)
        laws = ActuatorLaws(model, data)
        for _ in range(100):
            laws.step(np.eye(model.nu)[0])
        ends.append(data.qpos[0])
    assert ends[0] == ends[1] > 0.1


def test_a_driven_ball_and_a_second_free_body_are_refused_with_what_to_do(tmp_path: Path) -> None:
    """Locking is for hinges and slides, so it is not advised."""
    loose = "</body><body><freejoint name='box'/><geom size='.1'/></body><body><freejoint/><geom size='.1'/>"
    for parts in ({"child": BALL, "more": '<motor joint="ball" gear="1 0 0"/>'}, {"child": loose}):
        with pytest.raises(ConfigurationError, match=r"several coordinates.*remove <joint> or <freejoint>"):
            robot(write(tmp_path, **parts))


def test_an_unknown_actuator_is_named_first(tmp_path: Path) -> None:
    """A <dcmotor> is no reason to call recorded positions efforts; what the message writes moves alike."""
    path = write(tmp_path, '<dcmotor name="p" joint="hub" motorconst="0.3" resistance="2"/>')
    model = mujoco.MjModel.from_xml_path(str(path))
    assert joint_facts(path).motors == frozenset()
    with pytest.raises(ConfigurationError, match="'p' is a <dcmotor>") as refused:
        robot(path)
    instead = str(refused.value).partition("write <general ")[2].partition("/>")[0]
    other = write(tmp_path, f'<general name="p" joint="hub" {instead}/>')
    ends = []
    for one in (model, mujoco.MjModel.from_xml_path(str(other))):
        data = mujoco.MjData(one)
        data.ctrl[0] = 5.0
        mujoco.mj_step(one, data, 200)
        ends.append(data.qpos[0])
    assert ends[0] == pytest.approx(ends[1], abs=1e-9)
    assert robot(other).description.motors == () and robot(other).description.actuation == "motor"
