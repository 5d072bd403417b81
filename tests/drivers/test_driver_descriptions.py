"""Robots that are simulated and calibrated from recordings: descriptions, models and parameter sets agree."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.clock import MonotonicClock
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.robots import parameter_spaces, robot_description, robots
from deal_hw.robots.ant import description as ant_model
from deal_hw.robots.ant.description import DEFAULT, PAPER
from deal_hw.robots.connect import make_robot
from deal_hw.robots.humanoid import description as humanoid_model
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model, model_with
from deal_hw.sim.parameters import KIND_TABLE, check_space

ENTRIES = robots().entries()
DESCRIBED = [entry.name for entry in ENTRIES if entry.description]
EVERY = [(entry.name, name) for entry in ENTRIES for name in entry.parameter_spaces()]
SIZES = {
    ("allegro", "default"): 42,
    ("allegro", "paper"): 122,
    ("ant", "default"): 11,
    ("ant", "paper"): 11,
    ("humanoid", "default"): 50,
    ("humanoid", "paper"): 92,
    ("cartpole", "k9"): 9,
    ("cartpole", "k11"): 11,
    ("cartpole", "laws"): 11,
    ("cartpole", "paper"): 11,
    ("b2", "default"): 24,
    ("b2", "walk"): 29,
    ("b2_on_stand", "default"): 48,
    ("b2_on_stand", "biased"): 60,
    ("g1", "default"): 116,
    ("g1", "biased"): 145,
    ("g1_23dof", "default"): 92,
    ("g1_23dof", "biased"): 115,
    ("h1", "default"): 76,
    ("h1", "biased"): 95,
    ("go2", "default"): 24,
    ("go2", "paper"): 24,
    ("go2", "walk"): 29,
    ("go2", "paper-swapped"): 24,
    ("go2_on_stand", "default"): 48,
    ("go2_on_stand", "biased"): 60,
    ("go2_on_stand", "shared"): 12,
    ("go2_on_stand", "linkage"): 56,
    ("go2_on_stand", "laws"): 21,
    ("go2_suspended", "default"): 48,
    ("go2_suspended", "biased"): 60,
    ("go2_suspended", "shared"): 12,
    ("go2_suspended", "linkage"): 56,
    ("go2_suspended", "laws"): 21,
    ("so101", "biased"): 30,
    ("so101", "default"): 27,
    ("so101", "unbiased"): 24,
    ("so101", "laws"): 42,
}


def _space(robot: str, name: str) -> ParameterSpace:
    return parameter_spaces(robot)[name]()


@pytest.mark.parametrize("name", DESCRIBED)
def test_description_agrees_with_its_model(name: str) -> None:
    """Joints in model order, one actuator each, the base as given, effort limits as described."""
    description = robot_description(name)
    robot = load_model(description)
    model = robot.model
    assert description.name == name
    assert list(robot.qvel) == sorted(robot.qvel)
    assert (robot.base is not None) == (description.floating_base is not None)
    assert model.nv == len(description.joint_names) + (6 if description.floating_base else 0)
    for index, actuator, limit in zip(
        description.actuated_index, robot.actuator, description.effort_limit, strict=True
    ):
        assert model.actuator_trnid[actuator, 0] == np.flatnonzero(model.jnt_dofadr == robot.qvel[index])[0]
        if description.actuation == "position":
            assert model.actuator_forcerange[actuator].tolist() == [-limit, limit]
            assert model.actuator_gainprm[actuator, 0] == description.stiffness[0]
        else:
            assert model.actuator_gear[actuator, 0] == limit
            assert model.actuator_ctrlrange[actuator].tolist() == [-1.0, 1.0]
    assert math.isclose(description.device_rate_hz * model.opt.timestep, 1.0)
    for low, pose, high in zip(
        model.jnt_range[-len(description.joint_names) :, 0],
        description.default_position,
        model.jnt_range[-len(description.joint_names) :, 1],
        strict=True,
    ):
        assert low <= pose <= high


@pytest.mark.parametrize("name", DESCRIBED)
def test_every_number_has_a_source(name: str) -> None:
    """What a reader may doubt says where it comes from."""
    needed = {
        "joint_names",
        "default_position",
        "effort_limit",
        "control_rate_hz",
        "limits",
        "sensor",
        "mjcf",
    }
    assert needed <= set(robot_description(name).sources)


@pytest.mark.parametrize(("robot", "name"), EVERY)
def test_space_has_its_size_and_fits_its_model(robot: str, name: str) -> None:
    """Counts as in the paper's tables; kinds, elements and units are the model's; truths lie inside."""
    space = _space(robot, name)
    assert len(space) == SIZES[robot, name]
    model = load_model(robot_description(robot)).model
    check_space(model, space)
    for p in space.parameters:
        kind = KIND_TABLE[p.kind]
        index = getattr(model, kind.element)(p.elements[0]).id
        assert p.unit == kind.unit_of(model, index)
    for range_ratio in (3.0, 20.0):
        wide = space.with_ratio(range_ratio)
        check_space(model, wide)
        assert np.all((wide.nominal >= wide.low) & (wide.nominal <= wide.high))
        assert np.all((wide.center > wide.low) & (wide.center < wide.high))


@pytest.mark.parametrize("robot", [name for name in DESCRIBED if name != "go2_suspended"])
def test_default_preset_is_what_the_model_has(robot: str) -> None:
    """The nominal values of the first parameter set are the MJCF's own."""
    space, loaded = _space(robot, next(iter(parameter_spaces(robot)))), load_model(robot_description(robot))
    changed = model_with(loaded, space, space.nominal)
    for field in sorted({field for p in space for field in KIND_TABLE[p.kind].writes}):
        np.testing.assert_allclose(
            getattr(changed, field), getattr(loaded.model, field), rtol=1e-6, err_msg=field
        )


@pytest.mark.parametrize(("robot", "name"), EVERY)
def test_members_all_over_the_range_stay_finite(robot: str, name: str) -> None:
    """Half a second of steps under random commands, batch as the calibrator uses it; range ratio 5."""
    description = robot_description(robot)
    loaded, space = load_model(description), _space(robot, name)
    batch = ServoBatch(loaded, space, 8, threads=1)
    rng = np.random.default_rng(0)
    batch.set_parameters(space.sample(rng, 8))
    if loaded.model.nkey:
        batch.batch.bind("qpos")[:] = loaded.model.key_qpos[0]
    steps = round(0.5 / loaded.step_s)
    command = np.repeat(rng.uniform(-0.3, 0.3, (8, 5, len(description.actuated))), steps // 5, axis=1)
    if description.actuation == "position":
        command = command + np.array(description.default_position)[list(description.actuated_index)]
    position, velocity = batch.advance(command, every=5)
    assert np.isfinite(position).all() and np.abs(velocity).max() < 100


@pytest.mark.parametrize("name", ["allegro", "ant", "cartpole", "go2", "humanoid"])
def test_paper_preset_has_the_printed_values(name: str) -> None:
    """DEAL, Tables 7 to 11: sums of the printed columns, with Go2's 12 x 20 and 12 x 0.5."""
    # Table 7: 1.5 + .01 + .2 + .3 + .1 + .1 + .2 + .1 + .1 + .2 + 1 = 3.81
    # Table 11: 4 (1 + .01) + 21 .01 of friction; .04 + 2 .075 of armature; damping 15 + 2 28.1;
    # stiffness 50 + 2 71.
    # Table 8: .3 + .1 + .3 + .1 + .1 + .2 + .1 + .1 + .1 + .2 + 1 = 2.6
    # Table 10 but cube and palm: 21 (1 + .01) + 16 (.01 + .1 + .001 + 3) + 3 .144 + .128 of masses.
    wanted = {
        "allegro": 21.21 + 49.776 + 0.56,
        "ant": 3.81,
        "cartpole": 2.6,
        "go2": 246.0,
        "humanoid": 4.04 + 0.21 + 0.19 + 71.2 + 192.0,
    }
    assert _space(name, "paper").nominal.sum() == pytest.approx(wanted[name])


def _run(model: mujoco.MjModel, seconds: float) -> tuple[mujoco.MjData, np.ndarray]:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    start = np.array(data.qpos)
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return data, start


def test_go2_stands_still() -> None:
    """One second from the key frame: base within 3 mm, joints within 5 mrad, four feet on the floor."""
    model = load_model(robot_description("go2")).model
    data, start = _run(model, 1.0)
    assert np.abs(data.qpos[:3] - start[:3]).max() < 3e-3
    assert np.abs(data.qpos[7:] - start[7:]).max() < 5e-3
    assert np.abs(data.qvel).max() < 0.01
    names = {model.geom(g).name for c in data.contact for g in c.geom}
    assert names == {"floor", "FL_foot", "FR_foot", "RL_foot", "RR_foot"}


def test_go2_is_left_right_symmetric_and_weighs_what_its_source_says() -> None:
    """15.2 kg; mirrored legs have the same masses and mirrored origins."""
    model = load_model(robot_description("go2")).model
    assert model.body_mass.sum() == pytest.approx(6.921 + 4 * (0.678 + 1.152 + 0.241352))
    for part in ("hip", "thigh", "calf"):
        left, right = model.body(f"FL_{part}"), model.body(f"FR_{part}")
        np.testing.assert_allclose(left.pos * [1, -1, 1], right.pos)
        np.testing.assert_allclose(left.ipos * [1, -1, 1], right.ipos)


def test_only_feet_and_trunk_can_touch_the_floor_and_nothing_itself() -> None:
    """Contacts are what a step costs."""
    model = load_model(robot_description("go2")).model
    floor = model.geom("floor").id
    touching = [g for g in range(model.ngeom) if model.geom_contype[g] & model.geom_conaffinity[floor]]
    assert {model.geom(g).name for g in touching} == {"trunk", "FL_foot", "FR_foot", "RL_foot", "RR_foot"}
    assert not np.delete(model.geom_conaffinity, floor).any()


def test_so101_holds_its_arm_up() -> None:
    """At the nominal gain gravity bends it by less than 0.1 rad; dry friction does not creep."""
    model = load_model(robot_description("so101")).model
    data = mujoco.MjData(model)
    for _ in range(1500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos).max() < 0.1
    assert np.abs(data.qvel).max() < 1e-3


def test_ant_stands_on_its_feet() -> None:
    """Dropped from the start pose without torque it comes to rest on the floor, but for slow creep."""
    data, _ = _run(load_model(robot_description("ant")).model, 4.0)
    assert 0.2 < data.qpos[2] < 0.7
    assert np.abs(data.qvel).max() < 0.1


def test_ant_without_gymnasium_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """The model is gymnasium's and is not copied."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="gymnasium is not installed"):
        ant_model.MODEL.prepared_path({})


def test_ant_of_another_gymnasium_is_refused() -> None:
    """A file without the expected names is not half prepared."""
    with pytest.raises(ConfigurationError, match=r"gymnasium 1\.x"):
        ant_model.MODEL.prepare("<mujoco><worldbody/></mujoco>", {**DEFAULT, "contact.damping_ratio": 0.7})


def test_ant_is_prepared_once_and_mended_if_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cache holds one file a preset; a damaged one is written again, and no half files stay."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    values = {**PAPER, "contact.damping_ratio": 0.8}
    path = ant_model.MODEL.prepared_path(values)
    text = path.read_text(encoding="utf-8")
    path.write_text("<mujoco", encoding="utf-8")
    assert ant_model.MODEL.prepared_path(values).read_text(encoding="utf-8") == text
    assert [p.name for p in (tmp_path / "deal-hw").iterdir()] == [path.name]
    assert "material" not in text and "texture" not in text


def test_cache_that_cannot_be_written_falls_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home without a cache folder does not stop anybody."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert ant_model.MODEL.prepared_path({**DEFAULT, "contact.damping_ratio": 0.7}).is_file()


def test_humanoid_of_another_dm_control_is_refused() -> None:
    """A file without the expected names is not half prepared."""
    with pytest.raises(ConfigurationError, match=r"dm_control 1\.0"):
        humanoid_model.MODEL.prepare("<mujoco><option/></mujoco>", {"contact.damping_ratio": 0.7})


def test_humanoid_file_is_dm_controls_and_whole() -> None:
    """The copy loads with its includes, has the published numbers, and its licence stands beside it."""
    published = humanoid_model.MODEL.file()
    model = mujoco.MjModel.from_xml_path(str(published))
    assert (model.nq, model.nv, model.nu, model.nbody) == (28, 27, 21, 17)
    assert model.body_mass.sum() == pytest.approx(40.84, abs=0.01)
    assert "Apache License" in (published.parent / "LICENSE").read_text(encoding="utf-8")
    assert "dm_control 1.0.50" in (published.parent / "README.md").read_text(encoding="utf-8")


def test_humanoid_touches_the_floor_alone_and_has_no_textures() -> None:
    """A copy with textures has 12 MB; contacts among its bodies would double a step's cost."""
    model = load_model(robot_description("humanoid")).model
    assert model.ntex == model.nsite == 0
    data, _ = _run(model, 1.5)
    assert data.ncon and all("floor" in {model.geom(g).name for g in c.geom} for c in data.contact)
    # The published masses follow from density and shapes; 40.8 kg is dm_control's own.
    assert model.body_mass.sum() == pytest.approx(40.84, abs=0.01)


def test_humanoid_stands_on_feet_that_hold_it() -> None:
    """Each contact of a foot has friction: pushed sideways at 0.1 m/s, a foot slides only on smooth feet."""
    model = load_model(robot_description("humanoid")).model
    moved = []
    for friction in (1.0, 1e-3):
        for name in humanoid_model.FEET:
            model.geom(name).friction[0] = friction
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qvel[1] = 0.1
        foot = data.body("right_foot").id
        for _ in range(20):
            mujoco.mj_step(model, data)
        assert {contact.dim for contact in data.contact} == {3}
        moved.append(float(data.xpos[foot, 1]))
    assert abs(moved[0] - moved[1]) > 2e-3


def test_allegro_holds_its_cube() -> None:
    """Three seconds in the holding pose: the cube lies on the palm, and fingers touch nothing else."""
    model = load_model(robot_description("allegro")).model
    data = mujoco.MjData(model)
    pose = np.array(robot_description("allegro").default_position)
    data.qpos[7:], data.ctrl[:] = pose, pose
    for _ in range(600):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.qpos[:3] - model.qpos0[:3]) < 0.02
    assert np.abs(data.qpos[7:] - pose).max() < 0.05
    assert np.abs(data.qvel).max() < 0.05
    assert data.ncon and all("cube" in {model.geom(g).name for g in c.geom} for c in data.contact)


def test_robot_without_driver_says_so_and_lists_those_with_one() -> None:
    """A description is not a driver."""
    for name in (entry.name for entry in ENTRIES if not entry.driven):
        with pytest.raises(ConfigurationError, match=f"{name!r}.*no driver yet.*cartpole"):
            make_robot(name, "serial", "x", MonotonicClock())
    with pytest.raises(
        UnknownNameError,
        match=r"cartpole, go2, go2_on_stand, b2, b2_on_stand, g1, g1_23dof, h1, so101, allegro, ant",
    ):
        robot_description("gotwo")
    with pytest.raises(UnknownNameError, match="go2_suspended"):
        parameter_spaces("gotwo")
    # The Go2 on the floor and the SO-101 are simulated at other rates than their wires have.
    assert [entry.name for entry in ENTRIES if entry.driven and entry.description] == ["go2", "so101"]


def test_descriptions_load_no_simulator() -> None:
    """Facts are read where neither MuJoCo nor gymnasium is loaded."""
    names = list(DESCRIBED)
    code = (
        "import sys\n"
        "from deal_hw.robots import parameter_spaces, robot_description\n"
        f"for name in {names}: robot_description(name); parameter_spaces(name)\n"
        "print([m for m in ('torch', 'mujoco', 'scipy', 'gymnasium', 'yaml') if m in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.fixture
def changed() -> Callable[..., RobotDescription]:
    import dataclasses

    def change(**facts: object) -> RobotDescription:
        return dataclasses.replace(robot_description("go2"), **facts)  # type: ignore[arg-type]

    return change


def test_actuation_and_base_are_checked(changed: Callable[..., RobotDescription]) -> None:
    """A wrong actuation lists the allowed ones; the free joint is no joint of one coordinate."""
    with pytest.raises(ConfigurationError, match="allowed: position, motor"):
        changed(actuation="torque")
    with pytest.raises(ConfigurationError, match="must not be among joint_names"):
        changed(floating_base="FL_hip_joint")


def test_new_facts_keep_old_digests() -> None:
    """Recordings and policies of the cart-pole were made under these digests, before the new fields."""
    description = robot_description("cartpole")
    assert not {"actuation", "floating_base"} & set(description.to_json())
    assert description.digest() == "54e27dfd34a9ff09"
    assert robot_description("go2").to_json()["floating_base"] == "base"
    assert robot_description("ant").to_json()["actuation"] == "motor"
    uniform = ParameterDistribution.uniform(_space("cartpole", "k9"), (0.0, 0.02))
    assert all("prior_mean" not in values for values in uniform.to_json()["space"])
