"""Joints that an equality moves with another one: a gripper's second finger needs no reading."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import deal_hw
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.mjcf.exports import urdf_values
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.sim.parameters.followers import followers_of, natural_followers
from deal_hw.sim.robots.user_robot import derive_robot, read_robot
from deal_hw.types import FloatArray
from deal_hw.workflows.import_export import ImportSettings, import_recordings

GRIPPER = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="left">
      <joint name="left" type="slide" axis="1 0 0" damping="2" frictionloss="{friction}"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/>
    </body>
    <body name="right">
      <joint name="right" type="slide" axis="-1 0 0" ref="0.01" damping="2" frictionloss="0.1"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><position name="grip" joint="left" kp="300" kv="{kv}"/></actuator>
  <equality>{equality}</equality>
</mujoco>"""
SECOND = '<joint joint1="right" joint2="left" polycoef="0.002 1.5 2 0 0"/>'
FIRST = '<joint joint1="left" joint2="right" polycoef="0.002 -2 0 0 0"/>'


def gripper(equality: str = SECOND, friction: float = 0.3, kv: float = 30) -> str:
    """Return the gripper's MJCF."""
    return GRIPPER.format(equality=equality, friction=friction, kv=kv)


def numbers(text: str) -> list[tuple[int, int]]:
    """Return follower and leader of each follower of a gripper."""
    found = natural_followers(mujoco.MjModel.from_xml_string(text))
    return [(follower.joint, follower.leader) for follower in found]


@pytest.mark.parametrize(
    ("equality", "found"),
    [
        (SECOND, [(1, 0)]),
        (FIRST, [(1, 0)]),
        ('<joint joint1="right" polycoef="0.03 0 0 0 0"/>', [(1, -1)]),
        # An equality that is off moves nothing, and a curve has no unique inverse.
        (SECOND.replace("<joint ", '<joint active="false" '), []),
        (FIRST.replace("-2 0", "-2 1"), []),
        ("", []),
    ],
)
def test_what_follows(equality: str, found: list[tuple[int, int]]) -> None:
    """The finger without an actuator, whichever the equality names first; driven ones lead."""
    assert numbers(gripper(equality)) == found


def test_a_driven_joint_and_a_read_one_follow_nothing() -> None:
    """Their positions are recorded."""
    both = gripper().replace("</actuator>", '<motor joint="right"/></actuator>')
    assert numbers(both) == []
    assert followers_of(mujoco.MjModel.from_xml_string(gripper()), [0, 1]) == ()


def test_chains_and_passive_pairs() -> None:
    """A follower leads the next one; of two joints without an actuator the second one is read."""
    bodies = "".join(f'<body><joint name="{n}"/><geom size=".1"/></body>' for n in "abcd")
    pairs = (("c", "b"), ("b", "a"), ("d", "c"))
    joined = "".join(f'<joint joint1="{one}" joint2="{two}"/>' for one, two in pairs)
    text = f"<mujoco><worldbody>{bodies}</worldbody><equality>{joined}</equality></mujoco>"
    assert numbers(text) == [(1, 0), (2, 1), (3, 2)]


@pytest.mark.parametrize("equality", [SECOND, FIRST])
def test_start_states_satisfy_the_equality(equality: str, tmp_path: Path) -> None:
    """MuJoCo's own residual of the equality, and that of its speed, are zero."""
    path = tmp_path / "gripper.xml"
    path.write_text(gripper(equality))
    model = mujoco.MjModel.from_xml_path(str(path))
    robot = load_model(describe(path, model, ["left"], ["left"], sampling(0.01, 0.002, 0.2)))
    batch = ServoBatch(robot, default_space(model), 1, threads=1)
    batch.set_state(np.array([[0.02]]), np.array([[0.3]]))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = batch.batch.bind("qpos")[0], batch.batch.bind("qvel")[0]
    mujoco.mj_forward(model, data)
    at = np.flatnonzero(data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
    assert data.efc_pos[at] == pytest.approx([0.0], abs=1e-12)
    assert data.efc_vel[at] == pytest.approx([0.0], abs=1e-12)
    assert abs(data.qvel[1]) > 0.1


def record(seconds: float, seed: int) -> dict[str, FloatArray]:
    """Return 100 Hz of the real gripper, of its driven finger alone; 0.1 mm of noise."""
    model = mujoco.MjModel.from_xml_string(gripper(friction=0.6, kv=45))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.01)
    target = 0.02 * np.sin(4 * time + seed) + 0.01 * np.sin(11 * time)
    seen = np.empty(time.size)
    for k, wanted in enumerate(target):
        seen[k] = data.qpos[0]
        data.ctrl[0] = wanted
        mujoco.mj_step(model, data, 5)
    return {"time": time, "left_pos": seen + 1e-4 * rng.standard_normal(time.size), "left_cmd": target}


def write(path: Path, rows: dict[str, FloatArray]) -> Path:
    """Write columns as a CSV file."""
    table = np.stack(list(rows.values()), axis=1)
    np.savetxt(path, table, delimiter=",", header=",".join(rows), comments="")
    return path


def test_a_gripper_is_calibrated_by_its_driven_finger(tmp_path: Path) -> None:
    """No column of the follower is asked for; the drive's damping and friction within their intervals."""
    path = tmp_path / "gripper.xml"
    path.write_text(gripper())
    rest = {"grip.servo_stiffness": 300.0, "left.mass": 0.1, "right.mass": 0.1, "left.damping": 2.0}
    work = deal_hw.calibrate(
        path, record(6, 0), holdout=record(3, 1), known=rest | {"left.encoder_bias": 0.0}, threads=1
    )
    result, space = work.result, work.inputs.space
    assert set(space.names) == {"left.frictionloss", "grip.servo_damping"}
    for name, true in (("left.frictionloss", 0.6), ("grip.servo_damping", 45.0)):
        low, high = result.interval[space.names.index(name)]
        assert low < true < high, name
        assert result.estimate[space.names.index(name)] == pytest.approx(true, rel=0.1)
    # 2 q² is more than a URDF can say.
    assert "right" not in urdf_values(work.inputs.robot, result)["joints"]


def test_import_and_robot_yaml_need_no_follower(tmp_path: Path) -> None:
    """A dataset's robot has the driven finger alone; with a column of the follower it has both."""
    path, printed = tmp_path / "gripper.xml", list[str]()
    path.write_text(gripper(FIRST))
    rows = record(3, 0)
    one = write(tmp_path / "one.csv", rows)
    both = write(tmp_path / "both.csv", rows | {"right_pos": 0.01 - rows["left_pos"] / 2})
    for file, joints in ((one, ("left",)), (both, ("left", "right"))):
        out = tmp_path / file.stem
        import_recordings(ImportSettings(paths=(file,), model=path, out=out), say=printed.append)
        assert read_robot(out / "robot" / "robot.yaml").joint_names == joints
    assert not any("right: COLUMN" in line or "not in the file" in line for line in printed)
    robot = derive_robot(path, control_rate_hz=50)
    assert robot.joint_names == ("left",)
    wide = tmp_path / "wide.npz"
    np.savez(
        wide, time=rows["time"], dof_pos=rows["left_pos"][:, None], des_dof_pos=rows["left_cmd"][:, None]
    )
    import_recordings(ImportSettings(paths=(wide,), model=path, out=tmp_path / "wide"))
    values = yaml.safe_load((tmp_path / "wide" / "robot" / "robot.yaml").read_text())
    assert [joint["name"] for joint in values["joints"]] == ["left"]
