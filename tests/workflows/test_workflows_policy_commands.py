"""Commands from the policy that moved the robot: none recorded, another clock, another policy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deal_hw
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.paper.rollouts import control_ticks, rollout_population
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.table import Table
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.errors import ConfigurationError, DatasetError, PolicyMismatchError
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.sim.mjcf.joint_facts import JointFacts, joint_facts
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.policy_commands import with_policy_commands
from deal_hw.workflows.calibration.settings import FilesSettings, OwnDatasetSettings
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.import_export import ImportSettings, import_recordings
from deal_hw.workflows.own_robot.new import new_robot
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.shipped import required_policy

pytestmark = pytest.mark.real_time

STATES_A_TICK = 4
"""State samples of the cart-pole in one of its control periods."""
BRIEF: dict[str, Any] = {
    "method": "moments-unaligned",
    "free": ("cart.frictionloss", "cart.servo_stiffness"),
    "population": 8,
    "generations": 2,
    "threads": 1,
}
"""A search that only shows that it runs."""


@pytest.fixture(scope="module")
def policy() -> OnnxPolicy:
    """The policy that moves the robot."""
    return OnnxPolicy(required_policy("cartpole"))


@pytest.fixture(scope="module")
def facts() -> JointFacts:
    """Joints of the cart-pole's model."""
    return joint_facts(DESCRIPTION.mjcf)


@pytest.fixture(scope="module")
def table(policy: OnnxPolicy) -> Table:
    """Five seconds of balancing with noise and a latency, as a file of states and commands would be read."""
    return balanced(policy.path, "sensor")


def balanced(policy: Path, profile: str) -> Table:
    """Five seconds of balancing, as a file of states and commands would be read."""
    plan = RunPlan(robot="cartpole", motion="balance", seconds=5.0, policy=str(policy))
    robot = VirtualCartpole(draw_truth(profile, 1, range_ratio=2.0))
    run = robot.run(make_behaviour(plan, DESCRIPTION), plan.seconds).trajectory
    rows = np.flatnonzero(run.command_sequence >= 0)
    # A host that sends a command notes its own time; the robot's first states come before it.
    received_s = run.device_s[rows] - run.command_age_s[rows]
    _, first = np.unique(run.command_sequence[rows], return_index=True)
    begin = run.device_s[rows[0]]
    return Table(
        joint_names=("cart", "pole"),
        actuated=("cart",),
        units=("m", "rad"),
        time_s=run.device_s[rows] - begin,
        position=run.position[rows],
        velocity=run.velocity[rows],
        effort=None,
        command_s=received_s[first] - begin,
        target=run.position_target[np.searchsorted(run.sent_sequence, run.command_sequence[rows][first])],
        orientation=None,
        gyro=None,
        source={"file": "rec.csv", "part": ""},
    )


def without_commands(table: Table) -> Table:
    """The same states alone."""
    return dataclasses.replace(table, actuated=(), command_s=np.empty(0), target=np.empty((0, 0)))


def states_file(table: Table, folder: Path) -> Path:
    """The same states alone, in a file; positions alone where there are no velocities."""
    file, names, columns = folder / "states.csv", "time,cart.pos,pole.pos", [table.time_s, table.position]
    if table.velocity is not None:
        names, columns = f"{names},cart.vel,pole.vel", [*columns, table.velocity]
    np.savetxt(file, np.column_stack(columns), delimiter=",", header=names, comments="")
    return file


def test_states_alone_get_the_commands_that_were_sent(
    table: Table, policy: OnnxPolicy, facts: JointFacts
) -> None:
    """The sample of each period that the policy saw is found, and its commands are those of the run."""
    printed: list[str] = []
    (found,) = with_policy_commands([without_commands(table)], policy, facts, printed.append)
    assert found.actuated == ("cart",)
    assert np.allclose(np.diff(found.command_s), 1 / DESCRIPTION.control_rate_hz, atol=1e-6)
    # The robot reports a command some milliseconds after the state that it answers.
    late = table.target_at(found.command_s + 1.5 / DESCRIPTION.state_rate_hz)
    spread = np.sum((late - late.mean()) ** 2)
    assert np.sum((late - found.target) ** 2) < 0.02 * spread
    assert f"every {STATES_A_TICK} later" in printed[0] and "50 Hz" in printed[0]


def test_differences_stand_in_for_velocities(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """Without recorded velocities they are those over one control period, as this robot reports them."""
    bare = dataclasses.replace(without_commands(table), velocity=None)
    (found,) = with_policy_commands([bare], policy, facts, lambda _: None)
    (known,) = with_policy_commands([without_commands(table)], policy, facts, lambda _: None)
    assert np.corrcoef(found.target[:, 0], known.target[:, 0])[0, 1] > 0.95


def test_commands_on_the_states_clock_stay(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """They are the policy's, soon after the states that it saw; nothing is changed."""
    printed: list[str] = []
    (found,) = with_policy_commands([table], policy, facts, printed.append)
    np.testing.assert_array_equal(found.command_s, table.command_s)
    assert "both have one clock" in printed[0]


@pytest.mark.parametrize("apart_s", [-0.8, 0.6])
def test_another_clock_is_found_and_undone(
    table: Table, policy: OnnxPolicy, facts: JointFacts, apart_s: float
) -> None:
    """A recording whose commands come from another clock is aligned, and the distance is reported."""
    printed: list[str] = []
    off = dataclasses.replace(table, command_s=table.command_s + apart_s)
    (found,) = with_policy_commands([off], policy, facts, printed.append)
    moved_s = off.command_s - found.command_s
    assert np.ptp(moved_s) < 1e-12
    # The policy's own delay, at most a control period, goes with it.
    assert abs(float(moved_s[0]) - apart_s) <= 1 / DESCRIPTION.control_rate_hz
    assert "clocks are apart" in printed[0]


def test_commands_of_another_policy_are_refused(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """Commands that no shift in time explains: reported before any fit, with what to do."""
    wrong = dataclasses.replace(table, target=table.target[::-1])
    with pytest.raises(DatasetError, match=r"rec.csv: the recorded commands are not those of .*column map"):
        with_policy_commands([wrong], policy, facts, lambda _: None)


def test_commands_that_never_change_are_refused(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """They cannot be the policy's."""
    still = dataclasses.replace(table, target=np.zeros_like(table.target))
    with pytest.raises(DatasetError, match="not those of"):
        with_policy_commands([still], policy, facts, lambda _: None)


def test_joints_in_another_order_are_sorted(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """The recording follows the policy's order."""
    turned = dataclasses.replace(
        table,
        joint_names=("pole", "cart"),
        units=("rad", "m"),
        position=table.position[:, ::-1],
        velocity=None if table.velocity is None else table.velocity[:, ::-1],
    )
    (found,) = with_policy_commands([turned], policy, facts, lambda _: None)
    assert found.joint_names == ("cart", "pole") and found.units == ("m", "rad")
    np.testing.assert_array_equal(found.position, table.position)


def test_a_policy_that_does_not_fit_is_refused(table: Table, policy: OnnxPolicy, facts: JointFacts) -> None:
    """Other joints, a rate without a sample for each command, a policy of a walking robot, a short file."""
    other = dataclasses.replace(table, joint_names=("cart", "arm"))
    with pytest.raises(PolicyMismatchError, match="joints cart, arm"):
        with_policy_commands([other], policy, facts, lambda _: None)
    slow = table.rows(np.arange(len(table.time_s)) % 5 == 0)
    with pytest.raises(ConfigurationError, match="no whole multiple"):
        with_policy_commands([slow], policy, facts, lambda _: None)
    with pytest.raises(PolicyMismatchError, match="FL_hip"):
        with_policy_commands([table], OnnxPolicy(required_policy("go2")), facts, lambda _: None)
    short = without_commands(table).rows(np.arange(len(table.time_s)) < 8)
    with pytest.raises(DatasetError, match="record longer"):
        with_policy_commands([short], policy, facts, lambda _: None)


def test_a_file_of_states_is_prepared_with_its_policy(
    table: Table, policy: OnnxPolicy, tmp_path: Path
) -> None:
    """`calibrate --model --data states.csv --policy`: the episodes have the policy's commands."""
    file = states_file(table, tmp_path)
    settings = FilesSettings(model=DESCRIPTION.mjcf, data=(file,))
    with pytest.raises(DatasetError, match="--policy"):
        calibration_input(settings)
    printed: list[str] = []
    work = calibration_input(dataclasses.replace(settings, policy=str(policy.path)), say=printed.append)
    assert any("no commands, so they are those of" in line for line in printed)
    assert sum(len(np.unique(e.target)) for e in work.episodes) > 50


@pytest.mark.parametrize("velocities", [True, False])
def test_states_alone_are_compared_as_distributions(
    table: Table, policy: OnnxPolicy, tmp_path: Path, velocities: bool
) -> None:
    """The policy runs in every simulator; a clock in common is said, and a poor result is red."""
    if not velocities:
        table = dataclasses.replace(table, velocity=None)
    printed: list[str] = []
    found = deal_hw.calibrate(
        DESCRIPTION.mjcf,
        [states_file(table, tmp_path)],
        policy=policy.path,
        **BRIEF,
        say=printed.append,
    )
    assert any("no commands, so they are those of" in line for line in printed)
    assert any("have one clock" in line and "leave --method out" in line for line in printed)
    assert found.result.provenance["compares"] == "distributions" and found.colour == "red"
    space = found.result.space
    assert np.all((space.low <= found.result.estimate) & (found.result.estimate <= space.high))


def test_simulators_go_on_from_the_policys_past(policy: OnnxPolicy, tmp_path: Path) -> None:
    """A file begins while the policy runs: the first command of a rollout is the one that it gave there."""
    found = deal_hw.calibrate(
        DESCRIPTION.mjcf,
        [states_file(balanced(policy.path, "ideal"), tmp_path)],
        policy=policy.path,
        method="moments-unaligned",
        free=("cart.frictionloss",),
        population=4,
        generations=1,
        threads=1,
    )
    work = found.inputs
    assert work.policy is not None and work.policy.history > 0
    problem = Problem(work.robot, work.space, work.episodes, threads=1, policy=work.policy)
    members = Members(work.space.nominal[None], np.zeros(1))
    for index, episode in enumerate(work.episodes):
        ticks = control_ticks(problem, index, 20, work.policy.history, ran_before=work.policy.ran_before)
        _, _, action = rollout_population(problem, members, index, ticks)
        wanted = episode.target[ticks.action[0]]
        assert len(ticks.past) == work.policy.history
        assert abs(action[0, 0, 0] - wanted[0]) < 0.01 * np.ptp(episode.target)


@pytest.fixture(scope="module")
def own(table: Table, policy: OnnxPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the states, a file with the commands 0.6 s late, and a robot.yaml of the cart-pole."""
    folder = tmp_path_factory.mktemp("own")
    states_file(table, folder)
    late = table.target_at(table.time_s - 0.6)
    assert table.velocity is not None
    columns = np.column_stack([table.time_s, table.position, table.velocity, late])
    np.savetxt(
        folder / "late.csv",
        columns[columns[:, 0] > 0.6],
        delimiter=",",
        header="time,cart.pos,pole.pos,cart.vel,pole.vel,cart.cmd",
        comments="",
    )
    new_robot(
        DESCRIPTION.mjcf,
        out=folder / "robot.yaml",
        name="balancer",
        control_rate=DESCRIPTION.control_rate_hz,
        state_rate=DESCRIPTION.state_rate_hz,
    )
    return folder


def imported(
    own: Path, out: Path, file: str, policy: Path | None = None, said: list[str] | None = None
) -> Path:
    """Import a file with the robot.yaml, and with the policy if one is given."""
    config = ImportSettings(paths=(own / file,), out=out, robot=own / "robot.yaml", policy=policy)
    import_recordings(config, (said if said is not None else []).append)
    return out


def test_a_dataset_of_states_alone_keeps_its_policy(own: Path, policy: OnnxPolicy, tmp_path: Path) -> None:
    """`data import --policy` computes the commands; `calibrate DATASET` runs the kept policy by itself."""
    said: list[str] = []
    dataset = imported(own, tmp_path / "dataset", "states.csv", policy.path, said)
    assert any("no commands, so they are those of" in line for line in said)
    (kept,) = (dataset / "policies").iterdir()
    assert kept.read_bytes() == policy.path.read_bytes()
    printed: list[str] = []
    found = deal_hw.calibrate(
        dataset=dataset,
        **BRIEF,
        say=printed.append,
    )
    assert found.result.provenance["compares"] == "distributions"
    assert found.inputs.policy is not None and found.inputs.policy.ran_before
    assert found.inputs.robot.description.control_rate_hz == pytest.approx(DESCRIPTION.control_rate_hz)
    assert any("not that of the 2 searched parameters" in line for line in printed)
    named = OwnDatasetSettings(dataset=dataset, method="moments-unaligned", policy=policy.path, threads=1)
    work = calibration_input(named, say=printed.append)
    assert "both have one clock" in " ".join(printed)
    np.testing.assert_array_equal(work.episodes[0].target, found.inputs.episodes[0].target)


def test_a_datasets_wrong_clock_is_found_before_any_search(
    own: Path, policy: OnnxPolicy, tmp_path: Path
) -> None:
    """Commands 0.6 s late are moved: at the import, or in the calibration."""
    said: list[str] = []
    dataset = imported(own, tmp_path / "moved", "late.csv", policy.path, said)
    assert any("clocks are apart" in line for line in said)
    moved = Dataset.open(dataset).read(0).trajectory
    said.clear()
    late = imported(own, tmp_path / "late", "late.csv", None, said)
    assert any("hardly move together" in line and "have two clocks" in line for line in said)
    settings = OwnDatasetSettings(dataset=late, search="eki", policy=policy.path, threads=1, window=0.2)
    printed: list[str] = []
    work = calibration_input(settings, say=printed.append)
    assert any("clocks are apart" in line for line in printed)
    assert work.shown is not None
    begins = work.shown.sent_s[0] - Dataset.open(late).read(0).trajectory.sent_s[0]
    assert abs(begins + 0.6) <= 1.5 / DESCRIPTION.control_rate_hz
    at = np.searchsorted(moved.sent_s, 2.0), np.searchsorted(work.shown.sent_s, 2.0)
    np.testing.assert_allclose(moved.position_target[at[0]], work.shown.position_target[at[1]])
    assert work.policy is None


def test_a_policy_that_is_not_the_datasets_is_refused(own: Path, policy: OnnxPolicy, tmp_path: Path) -> None:
    """No policy for a method that runs one, another one, one of another size, a lost copy, no robot."""
    plain = imported(own, tmp_path / "plain", "late.csv")
    unaligned = OwnDatasetSettings(dataset=plain, method="deal-unaligned", threads=1)
    with pytest.raises(ConfigurationError, match="that was imported without it; name it"):
        calibration_input(unaligned)
    other = required_policy("go2")
    with pytest.raises(PolicyMismatchError, match="has the joints cart, pole, the policy FL_hip"):
        calibration_input(dataclasses.replace(unaligned, policy=other))
    with pytest.raises(ConfigurationError, match=r"commands of no joint.*--policy FILE\.onnx"):
        imported(own, tmp_path / "none", "states.csv")
    dataset = imported(own, tmp_path / "dataset", "states.csv", policy.path)
    kept = dataclasses.replace(unaligned, dataset=dataset)
    with pytest.raises(ConfigurationError, match="is not the policy with which the recordings were imported"):
        calibration_input(dataclasses.replace(kept, policy=other))
    next((dataset / "policies").iterdir()).unlink()
    with pytest.raises(ConfigurationError, match=r"has no copy of the policy.*--policy FILE"):
        calibration_input(kept)
    without = ImportSettings(paths=(own / "states.csv",), out=tmp_path / "x", policy=policy.path)
    with pytest.raises(ConfigurationError, match="--policy needs the robot that it moved"):
        import_recordings(without)
