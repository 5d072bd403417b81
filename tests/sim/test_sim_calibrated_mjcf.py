"""The calibrated MJCF: the user's text with other values in it, compiled to exactly the wanted model."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf.calibrated import change_mjcf

TOP = """<?xml version="1.0"?>
<!-- The user's own remark. -->
<mujoco model='walker'>
  <compiler meshdir="meshes"   autolimits="true"/>
\t<option timestep="0.002"/>
  <include file="parts/defaults.xml"/>
  <asset>
    <mesh name="shell" file="shell.obj"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="trunk" pos="0 0 1">   <!-- no inertial here: it comes from the mesh -->
      <freejoint name="root"/>
      <geom name="shell" type="mesh" mesh="shell"/>
      <include file="parts/leg.xml"/>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" class="servo"/>
    <general  name="knee" joint="knee" gainprm="30" biastype="affine" biasprm="0 -30 -2"/>
    <motor name="ankle" joint="ankle" gear="3"/>
  </actuator>
</mujoco>
"""
DEFAULTS = """<mujoco>
  <default>
    <joint damping="0.5" armature="0.01"/>
    <geom friction="0.8 0.01 0.001"/>
    <default class="servo"><position kp="40" dampratio="1" forcerange="-20 20"/></default>
  </default>
</mujoco>
"""
LEG = """<mujocoinclude>
  <body name="thigh">
    <inertial pos="0 0 -.1" mass="0.8" fullinertia="0.01 0.012 0.003 0.0005 0 0.0002"/>
    <joint name='hip' axis="0 1 0" range="-60 60"/>
    <geom name="thigh" type="capsule" fromto="0 0 0 0 0 -.2" size="0.03" mass="0"/>
    <body name="shank" pos="0 0 -.2">
      <joint name="knee" axis="0 1 0" frictionloss="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size="0.02"/>
      <frame pos="0 0 -.2">
        <body name="foot">
          <joint name="ankle" axis="0 1 0" springdamper="0.1 1"/>
          <geom name="foot" size="0.03"/>
          <geom name="toe" type="mesh" mesh="toe" pos=".05 0 0"/>
        </body>
      </frame>
    </body>
  </body>
</mujocoinclude>
"""
TOE = """<mujocoinclude>
  <option gravity="0 0 -9.8"/>
  <asset><mesh name="toe" file="toe.obj"/></asset>
</mujocoinclude>
"""


def tetrahedron(size: float) -> str:
    """Return an OBJ mesh of four corners."""
    corners = ((0, 0, 0), (size, 0, 0), (0, size, 0), (0, 0, size))
    return "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_model(folder: Path) -> Path:
    """Write the walker with its includes and meshes, one mesh beside the file that includes it."""
    (folder / "parts").mkdir(parents=True)
    (folder / "meshes").mkdir()
    top = TOP.replace("  <asset>", '  <include file="parts/toe.xml"/>\n  <asset>')
    for name, text in (
        ("walker.xml", top),
        ("parts/defaults.xml", DEFAULTS),
        ("parts/leg.xml", LEG),
        ("parts/toe.xml", TOE),
        ("meshes/shell.obj", tetrahedron(0.3)),
        ("parts/toe.obj", tetrahedron(0.05)),
    ):
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "walker.xml"


def load(path: Path) -> Any:
    """Compile a file."""
    return mujoco.MjModel.from_xml_path(str(path))


def changed(model: Any, change: Callable[[Any], None]) -> Any:
    """Return a copy with a change and the constants that follow from it."""
    other = copy.copy(model)
    change(other)
    mujoco.mj_setConst(other, mujoco.MjData(other))
    return other


def write(path: Path, target: Path, change: Callable[[Any], None]) -> Any:
    """Change a model's file; returns what the written one compiles to. The writer has compared all fields."""
    change_mjcf(path, target, changed(load(path), change), {}, "test")
    return load(target)


def test_only_changed_attributes_change_in_the_text(tmp_path: Path) -> None:
    """Beside the comment at the top one attribute differs; comments, tabs and quotes stay byte for byte."""
    path = write_model(tmp_path / "robot")
    target = tmp_path / "robot" / "calibrated.xml"

    def change(model: Any) -> None:
        model.actuator("knee").gainprm[0] = 33.5

    written = write(path, target, change)
    assert written.actuator("knee").gainprm[0] == 33.5
    before, after = path.read_text().splitlines(), target.read_text().splitlines()
    lines = [line for line in difflib.ndiff(before, after) if line[0] in "+-"]
    removed = [line[2:] for line in lines if line[0] == "-"]
    added = [line[2:] for line in lines if line[0] == "+"]
    assert removed == [
        '    <general  name="knee" joint="knee" gainprm="30" biastype="affine" biasprm="0 -30 -2"/>'
    ]
    assert added == [
        "<!-- Calibrated by deal-hw: test. A change of walker.xml:",
        "  actuator 'knee': gainprm 30 -> 33.5",
        " -->",
        '    <general  name="knee" joint="knee" gainprm="33.5" biastype="affine" biasprm="0 -30 -2"/>',
    ]


def test_changed_includes_are_written_beside_and_others_are_referred_to(tmp_path: Path) -> None:
    """A joint inside an included file: that file is copied with the change, others stay in place."""
    path = write_model(tmp_path / "robot")
    target = tmp_path / "runs" / "a" / "calibrated.xml"
    target.parent.mkdir(parents=True)

    def change(model: Any) -> None:
        model.dof_damping[model.joint("knee").dofadr] = 0.75
        model.opt.timestep = 0.001

    written = write(path, target, change)
    assert written.dof_damping[written.joint("knee").dofadr] == 0.75 and written.opt.timestep == 0.001
    assert sorted(p.name for p in target.parent.iterdir()) == [
        "calibrated.xml",
        "calibrated_leg.xml",
        "calibrated_toe.xml",
    ]
    text = target.read_text()
    assert 'file="../../robot/parts/defaults.xml"' in text and 'meshdir="../../robot/meshes"' in text
    toe = (target.parent / "calibrated_toe.xml").read_text()
    assert 'timestep="0.001"' in toe and 'file="../parts/toe.obj"' in toe
    leg = (target.parent / "calibrated_leg.xml").read_text()
    assert leg == LEG.replace('frictionloss="0.1"', 'frictionloss="0.1" damping="0.75"')


def test_mass_of_a_body_without_inertial_adds_one(tmp_path: Path) -> None:
    """The trunk's inertia came from its mesh: an <inertial> appears, on a line of its own."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.body("trunk").mass[0] *= 1.5
        model.body("trunk").inertia[:] *= 1.5

    write(path, tmp_path / "robot" / "c.xml", change)
    lines = (tmp_path / "robot" / "c.xml").read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if "<inertial" in line)
    assert lines[at].startswith("      <inertial pos=") and "<freejoint" in lines[at + 1]
    assert "no inertial here" in lines[at - 1]


def test_full_inertia_is_scaled_where_only_the_mass_changes(tmp_path: Path) -> None:
    """Twice the mass and inertia of the thigh: fullinertia times two, in the user's own axes."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.body("thigh").mass[0] *= 2
        model.body("thigh").inertia[:] *= 2

    write(path, tmp_path / "robot" / "c.xml", change)
    leg = (tmp_path / "robot" / "c_leg.xml").read_text()
    assert 'mass="1.6" fullinertia="0.02 0.024 0.006 0.001 0 0.0004"' in leg


def test_damping_ratio_gives_way_to_a_value(tmp_path: Path) -> None:
    """A class with dampratio would compute kv from the new mass; the calibrated kv is written instead."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.body("shank").mass[0] *= 3
        model.body("shank").inertia[:] *= 3

    nominal = load(path)
    written = write(path, tmp_path / "robot" / "c.xml", change)
    assert written.actuator("hip").biasprm[2] == pytest.approx(nominal.actuator("hip").biasprm[2], rel=1e-9)
    assert ' kv="' in (tmp_path / "robot" / "c.xml").read_text()


def test_motor_with_a_gain_becomes_general(tmp_path: Path) -> None:
    """A <motor> has no gain; the same actuator as <general> has, and keeps its gear."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.actuator("ankle").gainprm[0] = 0.9

    written = write(path, tmp_path / "robot" / "c.xml", change)
    assert written.actuator("ankle").gear[0] == 3
    assert '<general name="ankle" joint="ankle" gear="3"' in (tmp_path / "robot" / "c.xml").read_text()


def test_free_joint_with_damping_keeps_clear_of_the_joint_defaults(tmp_path: Path) -> None:
    """<freejoint> has no damping; as <joint> it would take the class's armature, which must stay out."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.dof_damping[:6] = 0.2

    written = write(path, tmp_path / "robot" / "c.xml", change)
    assert written.dof_damping[:6].tolist() == [0.2] * 6 and written.dof_armature[0] == 0


def test_angles_are_written_in_the_files_unit(tmp_path: Path) -> None:
    """Degrees are MJCF's default: a range of +-0.5 rad is written as +-28.6 degrees."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.joint("hip").range[:] = (-0.5, 0.5)

    written = write(path, tmp_path / "robot" / "c.xml", change)
    np.testing.assert_allclose(written.joint("hip").range, [-0.5, 0.5], rtol=1e-12)
    assert 'range="-28.64' in (tmp_path / "robot" / "c_leg.xml").read_text()


def test_elements_without_a_name_are_found_by_their_place(tmp_path: Path) -> None:
    """The shank's geom has no name: it is the fourth of the file's geoms."""
    path = write_model(tmp_path / "robot")
    nominal = load(path)
    (index,) = np.flatnonzero(nominal.geom_bodyid == nominal.body("shank").id)

    def change(model: Any) -> None:
        model.geom_friction[index] = (1.1, 0.02, 0.002)

    write(path, tmp_path / "robot" / "c.xml", change)
    assert (
        '<geom type="capsule" fromto="0 0 0 0 0 -.2" size="0.02" friction="1.1 0.02 0.002"/>'
        in (tmp_path / "robot" / "c_leg.xml").read_text()
    )


def test_calibrated_again_keeps_one_set_of_numbers(tmp_path: Path) -> None:
    """What MuJoCo has no field for is replaced, not added, when a calibrated file is calibrated again."""
    path = write_model(tmp_path / "robot")
    first, second = tmp_path / "robot" / "first.xml", tmp_path / "robot" / "second.xml"
    change_mjcf(path, first, load(path), {"deal_hw.encoder_bias": ([0.1, -0.2], ["hip", "knee"])})
    change_mjcf(first, second, load(first), {"deal_hw.encoder_bias": ([0.3], ["hip"])})
    model = load(second)
    assert model.nnumeric == 1 and model.numeric("deal_hw.encoder_bias").data.tolist() == [0.3]
    assert second.read_text().count('<text name="deal_hw.encoder_bias.elements" data="hip"/>') == 1


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass':UserWarning")
def test_total_mass_setting_gives_way_to_the_masses(tmp_path: Path) -> None:
    """Settotalmass would scale the calibrated mass away: all masses are written out instead."""
    path = tmp_path / "two.xml"
    path.write_text(
        '<mujoco><compiler settotalmass="5"/><worldbody><body name="a"><joint/><geom size=".1"/>'
        '<body name="b"><joint axis="1 0 0"/><geom size=".05"/></body></body></worldbody></mujoco>'
    )

    def change(model: Any) -> None:
        model.body("b").mass[0] *= 2
        model.body("b").inertia[:] *= 2

    nominal = load(path)
    written = write(path, tmp_path / "c.xml", change)
    assert written.body("a").mass[0] == pytest.approx(nominal.body("a").mass[0], rel=1e-9)
    assert written.body("b").mass[0] == pytest.approx(2 * nominal.body("b").mass[0], rel=1e-9)


def test_fields_without_an_attribute_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    """A field outside the table is named, with what can be written."""
    path = write_model(tmp_path / "robot")

    def change(model: Any) -> None:
        model.geom_surfacevel[0, 0] = 0.3

    with pytest.raises(ConfigurationError, match=r"geom_surfacevel.*dof_damping.*geom_friction"):
        write(path, tmp_path / "c.xml", change)
    assert not (tmp_path / "c.xml").exists()


def test_elements_that_a_macro_makes_are_written_out(tmp_path: Path) -> None:
    """A body inside <replicate> stands once in the text and many times in the model: each gets a text."""
    path = tmp_path / "many.xml"
    path.write_text(
        '<mujoco><worldbody><replicate count="3" offset="1 0 0"><body name="b"><joint name="j"/>'
        '<geom size=".1"/></body></replicate></worldbody></mujoco>'
    )

    def change(model: Any) -> None:
        model.dof_damping[1] = 0.3

    assert write(path, tmp_path / "c.xml", change).dof_damping.tolist() == [0.0, 0.3, 0.0]
    text = (tmp_path / "c.xml").read_text()
    assert "written out in full" in text and text.count("<joint") == 3
    assert {file.name for file in tmp_path.iterdir()} == {"many.xml", "c.xml"}


def test_attached_models_are_written_out(tmp_path: Path) -> None:
    """Two arms of one file, with meshes beside it, in frames: found from the folder of the new file.

    Numbers have the six digits that MuJoCo writes; those that change have all of theirs.
    """
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    (tmp_path / "parts" / "meshes" / "link.obj").write_text(tetrahedron(0.2))
    (tmp_path / "parts" / "arm.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><default><joint damping="0.1234567891"/></default>'
        '<asset><mesh name="link" file="link.obj"/></asset>'
        '<worldbody><body name="link"><joint name="hub"/><geom type="mesh" mesh="link"/></body></worldbody>'
        '<actuator><position name="hub" joint="hub" kp="3"/></actuator></mujoco>'
    )
    path = tmp_path / "cell.xml"
    arms = "".join(
        f'<frame pos="{x} 0 0" euler="0 0 33"><attach model="arm" body="link" prefix="{side}_"/></frame>'
        for side, x in (("l", 0.123456789), ("r", -1))
    )
    path.write_text(
        '<mujoco><asset><model name="arm" file="parts/arm.xml"/></asset>'
        f'<worldbody>{arms}<camera pos="0.123456789 0 0"/></worldbody></mujoco>'
    )

    def change(model: Any) -> None:
        model.joint("r_hub").damping[0] = 0.23456789123
        model.body("l_link").mass[0] *= 1.1
        model.body("l_link").inertia[:] *= 1.1
        model.actuator("l_hub").gainprm[0], model.actuator("l_hub").biasprm[1] = 4.5, -4.5

    (tmp_path / "out").mkdir()
    model = write(path, tmp_path / "out" / "c.xml", change)
    assert model.joint("r_hub").damping[0] == 0.23456789123
    assert model.joint("l_hub").damping[0] == pytest.approx(0.1234567891, rel=5e-6)
    assert model.actuator("l_hub").gainprm[0] == 4.5
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["c.xml"]


def test_file_that_is_not_well_formed_says_where(tmp_path: Path) -> None:
    """MuJoCo's reader takes two attributes of one name; a rewrite in place cannot."""
    path = tmp_path / "twice.xml"
    path.write_text('<mujoco>\n<worldbody><geom size=".1" size=".2"/></worldbody></mujoco>')
    with pytest.raises(ConfigurationError, match=r"twice\.xml is not well-formed.*line 2"):
        change_mjcf(path, tmp_path / "c.xml", mujoco.MjModel.from_xml_string("<mujoco/>"), {})


def test_the_model_itself_is_never_overwritten(tmp_path: Path) -> None:
    """Writing onto the user's file is refused."""
    path = write_model(tmp_path / "robot")
    with pytest.raises(ConfigurationError, match="the model itself"):
        change_mjcf(path, path, load(path), {})


VALUE = st.floats(1e-4, 1e3, allow_nan=False).map(lambda v: float(f"{v:.17g}"))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=st.lists(VALUE, min_size=6, max_size=6),
    quat=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
    seed=st.integers(0, 2**16),
)
def test_any_change_of_the_usual_fields_comes_back(
    tmp_path: Path, values: list[float], quat: list[float], seed: int
) -> None:
    """Random values in masses, inertias, frames, joints, contacts and actuators compile to exactly those."""
    robot = tmp_path / "robot"
    path = robot / "walker.xml" if robot.exists() else write_model(robot)
    out = tmp_path / "elsewhere"
    out.mkdir(exist_ok=True)
    rng = np.random.default_rng(seed)

    def change(model: Any) -> None:
        body = int(rng.integers(1, model.nbody))
        model.body_mass[body] *= values[0]
        # A rod of any size: the inertias keep the triangle inequality that the compiler checks.
        model.body_inertia[body] *= values[0]
        if rng.random() < 0.5:
            model.body_ipos[body] += rng.normal(size=3)
            model.body_iquat[body] = np.array(quat) / np.linalg.norm(quat)
        dof = int(rng.integers(6, model.nv))
        model.dof_damping[dof], model.dof_armature[dof], model.dof_frictionloss[dof] = values[1:4]
        model.dof_solimp[dof, :2] = rng.uniform(0.5, 0.9)
        geom = int(rng.integers(model.ngeom))
        model.geom_friction[geom, 0], model.geom_solref[geom, 0] = values[4], rng.uniform(0.01, 0.1)
        servo = int(rng.integers(2))
        model.actuator_gainprm[servo, 0], model.actuator_biasprm[servo, 1] = values[5], -values[5]
        model.actuator_biasprm[servo, 2] = -rng.uniform(0, 5)
        model.actuator_forcerange[servo] = (-values[1], values[1])

    written = write(path, out / "c.xml", change)
    assert written.nbody == 5
