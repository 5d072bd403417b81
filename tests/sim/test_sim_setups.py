"""Set-ups: read from YAML, checked against each other and the model, and simulated each on its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.sine_arm import MJCF

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import BatchPool
from deal_hw.sim.engine.model import RobotModel, at_step, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.parameters.yaml_space import parse_space
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.own_setups import in_own_setups, own_setup
from deal_hw.sim.recordings.setups import Setups, parse_setups, read_setups, with_setups

JOINTS = ("yaw", "pitch", "elbow")
LOADED = """setups:
  loaded: {recordings: 'loaded*', payload: {body: lower, name: weight, at: [0, 0, 0.22], range: [0.02, 1]}}
  light:
    {recordings: 3, payload: {body: upper, name: disk, mass: 0.1}, stiffness: {'p*': 12}, damping: {elbow: 2}}
"""


@pytest.fixture
def robot(tmp_path: Path) -> RobotModel:
    path = tmp_path / "arm.xml"
    path.write_text(MJCF, encoding="utf-8")
    model = mujoco.MjModel.from_xml_path(str(path))
    rates = sampling(0.01, model.opt.timestep, 0.4)
    return load_model(describe(path, model, JOINTS, JOINTS, rates), rates.step_s)


def _space(robot: RobotModel, entries: str = "{kind: body_mass, elements: lower}") -> ParameterSpace:
    return parse_space(f"parameters:\n  - {entries}", robot.model)


def _episode(name: str) -> SampledEpisode:
    ones, rows = np.ones((50, 3)), np.arange(6)
    return SampledEpisode(
        step_s=0.01,
        sample=rows * 10,
        position=np.zeros((6, 3)),
        velocity=np.zeros((6, 3)),
        target=0 * ones,
        stiffness=30 * ones,
        damping=ones,
        effort_limit=np.inf * ones,
        speed_limit=np.inf * ones,
        usable=np.ones(6, dtype=bool),
        start_setpoint=np.zeros(3),
        name=name,
    )


@pytest.mark.parametrize(
    ("recording", "setup"),
    [
        ("loaded_1.csv", "loaded"),
        ("folder/loaded_2.csv, part 2 of 3", "loaded"),
        ("000003.mcap", "light"),
        ("empty.csv", ""),
        ("unloaded.csv", ""),
    ],
)
def test_recordings_are_found_by_name_pattern_or_number(recording: str, setup: str) -> None:
    """With and without folder, extension and part; other recordings are made with the model itself."""
    assert parse_setups(LOADED).of(recording) == setup


def test_each_setup_has_its_own_mass_and_the_shared_parameter_in_all(robot: RobotModel) -> None:
    """An unknown payload is a parameter of its set-up only; a link's mass is written in every model."""
    setups = parse_setups(LOADED)
    whole = setups.robot(robot, _space(robot))
    space = with_setups(_space(robot), whole, setups)
    assert space.names == ("lower.mass", "weight.mass")
    assert whole.in_setup("light").model.body("disk").mass[0] == 0.1
    pool = BatchPool(whole, space, threads=1)
    for name, carried in (("", 0.0), ("loaded", 0.3), ("light", 0.1)):
        batch = pool.get(2, name)
        batch.set_parameters(np.array([[0.6, 0.3], [0.7, 0.3]]))
        total = [batch.batch.get_model(n).body_mass.sum() for n in range(2)]
        np.testing.assert_allclose(total, [1.9 + carried, 2.0 + carried])
    assert pool.get(2, "loaded") is not pool.get(2)
    member = pool.get(2, "loaded").batch.get_model(0)
    np.testing.assert_allclose(member.body("weight").inertia, 0.4 * 0.3 * 0.02**2)
    assert at_step(whole, 1e-3).in_setup("loaded").step_s == 1e-3


def test_gains_of_a_setup_replace_the_sent_ones(robot: RobotModel) -> None:
    """Of the joints that its patterns match, in its recordings only."""
    setups = parse_setups(LOADED)
    marked = setups.with_gains(_episode("000003.mcap"), robot)
    assert marked.setup == "light"
    assert marked.stiffness[0].tolist() == [30, 12, 30] and marked.damping[-1].tolist() == [1, 1, 2]
    other = _episode("empty.csv")
    assert setups.with_gains(other, robot) is other


def test_another_mjcf_is_a_setup(robot: RobotModel, tmp_path: Path) -> None:
    """A longer arm beside the file of set-ups; joints and actuators are found by name."""
    longer = MJCF.replace('name="lower" pos="0 0 0.25"', 'name="lower" pos="0 0 0.35"')
    (tmp_path / "long.xml").write_text(longer, encoding="utf-8")
    file = tmp_path / "setups.yaml"
    file.write_text("setups: {long: {recordings: '*', mjcf: long.xml}}", encoding="utf-8")
    found = read_setups(file).robot(robot, _space(robot)).in_setup("long")
    assert found.model.body("lower").pos[2] == 0.35 and found.description == robot.description


def test_the_zero_of_a_setup_acts_in_its_recordings_only(robot: RobotModel) -> None:
    """Of the joints that its patterns match; the model itself has none."""
    setups = parse_setups("setups: {a: {recordings: r1, encoder_bias: {pitch: 0.2, 'e*': 0.1}}}")
    whole = setups.robot(robot, _space(robot))
    space = with_setups(_space(robot), whole, setups)
    assert space.names == ("lower.mass", "pitch.encoder_bias@a", "elbow.encoder_bias@a")
    assert (space["elbow.encoder_bias@a"].low, space["elbow.encoder_bias@a"].high) == (-0.1, 0.1)
    pool = BatchPool(whole, space, threads=1)
    for name, reported in (("a", [0.0, 0.15, -0.05]), ("", [0.0, 0.0, 0.0])):
        batch = pool.get(1, name)
        batch.set_parameters(np.array([[0.5, 0.15, -0.05]]))
        np.testing.assert_allclose(batch.position[0], reported)


def test_two_zeros_of_one_joint_are_refused(robot: RobotModel) -> None:
    """One of all recordings, and another one of a set-up."""
    setups = parse_setups("setups: {a: {recordings: r1, encoder_bias: {'*': 0.2}}}")
    space = _space(robot, "{kind: encoder_bias, elements: elbow, range: [-0.1, 0.1]}")
    with pytest.raises(ConfigurationError, match="both set encoder_bias of 'elbow'; keep one"):
        with_setups(space, setups.robot(robot, space), setups)


def test_a_recording_with_parameters_of_its_own_is_a_setup(robot: RobotModel) -> None:
    """Its parts between gaps share it, and the set-up in which it was made goes on to act."""
    setups = parse_setups("setups: {a: {recordings: r1, encoder_bias: {pitch: 0.2}}}")
    whole = setups.robot(robot, _space(robot))
    zero = Parameter.encoder_bias("elbow", 0.1, setup=own_setup("r1.csv"))
    space = ParameterSpace([*with_setups(_space(robot), whole, setups), zero])
    assert zero.name == "elbow.encoder_bias@r1.csv"
    names = ["r1.csv, part 1 of 2", "r1.csv, part 2 of 2", "r2.csv"]
    found, episodes = in_own_setups(
        whole, [setups.with_gains(_episode(name), robot) for name in names], space
    )
    assert [e.setup for e in episodes] == ["@r1.csv", "@r1.csv", ""]
    acting = [p.name for p in found.in_setup("@r1.csv").acting(space).free if p.elements]
    assert acting == ["lower.mass", "pitch.encoder_bias@a", "elbow.encoder_bias@r1.csv"]
    assert [p.name for p in found.acting(space).free if p.elements] == ["lower.mass"]
    # Once more changes nothing, and without such parameters nothing is changed at all.
    assert in_own_setups(found, episodes, space)[1] == episodes
    assert in_own_setups(whole, episodes, _space(robot)) == (whole, episodes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "must hold one key, `setups`"),
        ("setups: {}", "at least one name"),
        ("setups: {a: {payload: {body: lower}}}", "`recordings` must name the recordings"),
        ("setups: {a: {recordings: x, pay: 1}}", "unknown key 'pay'"),
        ("setups: {a: {recordings: x, payload: {mass: 1}}}", "needs the `body` that carries it"),
        ("setups: {a: {recordings: x, payload: {body: b, mass: 1, range: [1, 2]}}}", "give one"),
        ("setups: {a: {recordings: x, payload: {body: b, mass: 0}}}", "leave `payload` out"),
        ("setups: {a: {recordings: x, payload: {body: b, mass: 200 g}}}", "payload's mass"),
        ("setups: {a: {recordings: x, payload: {body: b, at: 0.1}}}", "`at` must be a list of 3 numbers"),
        (
            "setups: {a: {recordings: x, payload: {body: b, mass: 1.0e+9}}}",
            "mass is 1e+09 kg; allowed: up to",
        ),
        (
            "setups: {a: {recordings: x, payload: {body: b, at: [0, 0, 1.0e+300]}}}",
            "payload's at is 1e+300 m",
        ),
        ("setups: {a: {recordings: x, payload: {body: b, radius: 1.0e+300}}}", "radius is 1e+300 m"),
        ("setups: {a: {recordings: x, stiffness: {'*': 1.0e+300}}}", "stiffness of * is 1e+300 N/m"),
        ("setups: {a: {recordings: x, encoder_bias: {'*': 1.0e+300}}}", "encoder_bias of * is 1e+300 rad"),
        ("setups: {a: {recordings: x, stiffness: 12}}", "a value for each joint or pattern"),
        ("setups: {'@a': {recordings: x}}", "must not begin with '@'"),
        (
            "setups: {a: {recordings: x, payload: {body: b, mass: 0.2}}, "
            "b: {recordings: y, payload: {body: b, mass: 0.3}}}",
            "another mass in set-up 'b' (0.3) than in 'a' (0.2); give different things different names",
        ),
    ],
)
def test_files_that_cannot_be_used_say_what_to_write(text: str, words: str) -> None:
    """Each message names the entry."""
    with pytest.raises(ConfigurationError) as caught:
        parse_setups(text)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "entries", "words"),
    [
        (
            "a: {recordings: x, payload: {body: hand}}",
            "{kind: body_mass, elements: lower}",
            "payload of set-up 'a': unknown body 'hand'; known: shoulder, upper, lower",
        ),
        (
            "a: {recordings: x, payload: {body: lower, name: upper}}",
            "{kind: body_mass, elements: lower}",
            "has a body 'upper' already; give the payload another `name`",
        ),
        (
            "a: {recordings: x, mjcf: heavy.xml}",
            "{kind: body_mass, elements: lower}",
            "another body_mass of 'lower' (0.9 kg) than the model (0.5 kg), but parameter 'lower.mass' sets",
        ),
        (
            "a: {recordings: x, mjcf: other.xml}",
            "{kind: dof_damping, elements: yaw}",
            "unknown MuJoCo joint 'elbow'",
        ),
    ],
)
def test_setups_that_contradict_the_model_are_refused(
    robot: RobotModel, tmp_path: Path, text: str, entries: str, words: str
) -> None:
    """A payload on nothing, or one value for what differs between set-ups."""
    (tmp_path / "heavy.xml").write_text(
        MJCF.replace('mass="0.5" diaginertia="0.002', 'mass="0.9" diaginertia="0.002')
    )
    (tmp_path / "other.xml").write_text(MJCF.replace('"elbow"', '"hinge"'))
    setups = parse_setups(f"setups:\n  {text}", folder=tmp_path)
    with pytest.raises(ConfigurationError) as caught:
        setups.robot(robot, _space(robot, entries))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{a: {recordings: 'r*'}, b: {recordings: r1}}", "a and b both claim recording r1.csv"),
        ("{a: {recordings: q}}", "no recording belongs to set-up 'a'"),
        ("{a: {recordings: r1, stiffness: {wrist: 3}}}", "unknown joint 'wrist'"),
        ("{a: {recordings: r1, encoder_bias: {wrist: 0.1}}}", "unknown joint 'wrist'"),
    ],
)
def test_setups_that_do_not_fit_the_recordings_are_refused(robot: RobotModel, text: str, words: str) -> None:
    """Two claims, none, gains of no servo, or a zero of no joint."""
    with pytest.raises(ConfigurationError) as caught:
        parse_setups(f"setups: {text}").check_used(["r1.csv", "r2.csv"], robot.description)
    assert words in str(caught.value)


def test_gains_of_motors_are_refused(robot: RobotModel) -> None:
    """A motor that takes efforts has no gains."""
    setups: Setups = parse_setups("setups: {a: {recordings: r1, stiffness: {'*': 3}}}")
    motors = dataclasses.replace(robot.description, actuation="motor")
    with pytest.raises(ConfigurationError, match="motors that take efforts have no gains"):
        setups.check_used(["r1.csv"], motors)
