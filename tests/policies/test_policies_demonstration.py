"""pi_0 in the loop: shipped files, targets that they drive, populations in the calibrator's closed loop."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import digest
from deal_hw.calib.paper.algorithm1 import DealPaper, PaperSettings
from deal_hw.calib.paper.rollouts import control_ticks, rollout_population
from deal_hw.calibration import Budget
from deal_hw.errors import PolicyMismatchError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.policies.demonstration import (
    ASSETS,
    SHIPPED,
    Demonstration,
    PopulationDemonstration,
    demonstration_policy,
    limited_action,
)
from deal_hw.policies.go2_env import walk_spec
from deal_hw.policies.locomotion import judge
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import Observation, PolicySpec
from deal_hw.robots import default_space, robot_description, training_task
from deal_hw.rotations import in_base_frame
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.tangent_coordinates import IDENTITY, to_vector
from deal_hw.sim.recordings.target import TargetRecording, record_target
from deal_hw.types import FloatArray
from deal_hw.workflows.shipped import shipped_policy
from deal_hw.workflows.train import udr_distribution

FLOATING = ("allegro", "ant", "go2", "humanoid")
GO2 = robot_description("go2")
WALK = (0.4, 0.0, 0.0)


def loaded(robot: str) -> tuple[RobotModel, ParameterSpace]:
    space = default_space(robot)
    return load_model(robot_description(robot)), space.with_ratio(2.0)


def recorded(
    robot: str, seed: int, seconds: float
) -> tuple[RobotModel, ParameterSpace, FloatArray, TargetRecording]:
    model, space = loaded(robot)
    rng = np.random.default_rng(seed)
    theta = space.sample(rng, 1)[0]
    behaviour = Demonstration(demonstration_policy(robot), model.description, WALK)
    # Without torque a humanoid falls within a second.
    settle_s = 0.0 if robot == "humanoid" else 1.0
    made = record_target(model, space, theta, behaviour, seconds=seconds, rng=rng, settle_s=settle_s)
    return model, space, theta, made


@pytest.mark.parametrize("robot", SHIPPED)
def test_shipped_policies_fit_their_robots_and_their_records(robot: str) -> None:
    """Each loads, is small, was made for this robot, and is the file that its record speaks of."""
    policy = demonstration_policy(robot)
    policy.spec.check_fits(robot_description(robot))
    path = ASSETS / f"{robot}_udr.onnx"
    record = json.loads(path.with_suffix(".json").read_text())
    assert path.stat().st_size < 200_000
    assert record["spec_digest"] == policy.spec.digest()
    assert record["distribution_digest"] == policy.spec.trained_under
    if robot in FLOATING:
        assert record["onnx_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert {"return_mean", "fall_rate", "forward_speed_m_s"} <= record["evaluation"].keys()
        assert {"seconds", "seed", "machine", "training"} <= record.keys()


def test_there_is_no_policy_for_every_robot() -> None:
    """The message lists those that have one."""
    with pytest.raises(UnknownNameError, match="cartpole"):
        demonstration_policy("go2_suspended")


@pytest.mark.parametrize("robot", FLOATING)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_target_is_driven_without_divergence_and_moves(robot: str, seed: int) -> None:
    """Two seconds on a random truth: finite states, commands inside the limits, joints that move."""
    model, _, _, made = recorded(robot, seed, 2.0)
    description = model.description
    assert np.isfinite(made.position).all() and np.isfinite(made.velocity).all()
    low, high = np.array(description.limits.target).T
    target = made.episode.target
    assert (target >= low - 1e-9).all() and (target <= high + 1e-9).all()
    assert (np.abs(np.diff(target, axis=0)) <= np.array(description.limits.target_step) + 1e-9).all()
    assert made.position[:, model.joints].std(axis=0).min() > 5e-3
    if robot == "humanoid":
        return
    # Staying up is stated in the records of these early checkpoints; here they must not lie on their backs.
    assert made.episode.reference is not None
    turn = to_vector(made.episode.reference, IDENTITY)
    down = in_base_frame(turn, np.broadcast_to([0.0, 0.0, -1.0], turn.shape))[:, 2]
    assert (down < -0.3).mean() > 0.5


@pytest.mark.parametrize("robot", FLOATING)
def test_the_truth_in_closed_loop_repeats_the_target(robot: str) -> None:
    """In the calibrator's closed loop the true member does what the target did, and others do otherwise."""
    model, space, theta, made = recorded(robot, 2, 0.6)
    population = PopulationDemonstration(demonstration_policy(robot), model.description, WALK)
    problem = Problem(model, space, [made.episode], threads=1, fixed_latency_s=0.0, policy=population)
    ticks = control_ticks(problem, 0, history=population.history)
    members = Members(np.stack([theta, space.center]), np.zeros(2))
    position, _, action = rollout_population(problem, members, 0, ticks)
    wanted = made.episode.target[ticks.action]
    joints = made.position[ticks.sample][:, model.joints]
    short = 10
    assert np.abs(action[0, :short] - wanted[:short]).max() < 1e-3
    assert np.abs(position[0, :short, model.joints] - joints[:short]).max() < 1e-3
    assert np.abs(position[1, :short, model.joints] - joints[:short]).max() > 1e-3


@pytest.mark.parametrize("replay", [False, True])
def test_rollouts_do_not_depend_on_the_number_of_threads(replay: bool) -> None:
    """To the last bit, with five members on one, two and three threads."""
    model, space, _, made = recorded("ant", 2, 0.6)
    theta, latency_s = space.sample(np.random.default_rng(0), 5), np.array([0.0, 0.004, 0.0, 0.02, 0.001])
    found = []
    for threads in (1, 2, 3):
        population = PopulationDemonstration(demonstration_policy("ant"), model.description, WALK)
        problem = Problem(model, space, [made.episode], threads=threads, policy=population)
        ticks = control_ticks(problem, 0, history=population.history)
        found.append(rollout_population(problem, Members(theta, latency_s), 0, ticks, replay=replay))
    for other in found[1:]:
        for array, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(array, same)


@pytest.mark.parametrize(
    "robot", [pytest.param(name, marks=[pytest.mark.slow] * (name == "allegro")) for name in FLOATING]
)
def test_the_paper_takes_pi_0_in_the_loop(robot: str) -> None:
    """`deal-paper` with the policy instead of its recorded actions runs to the end, inside the ranges."""
    model, space, _, made = recorded(robot, 3, 1.0)
    population = PopulationDemonstration(demonstration_policy(robot), model.description, WALK)
    problem = Problem(model, space, [made.episode], threads=1, fixed_latency_s=0.0, policy=population)
    method = DealPaper(PaperSettings(ticks=20))
    budget = Budget(population=4, generations=2, refine=False)
    found = method.run(problem, budget, np.random.default_rng(0))
    assert (found.estimate >= space.low).all() and (found.estimate <= space.high).all()


class Leap:
    """Asks for the largest action at once, and remembers what it saw."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        self.seen: list[Observation] = []

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return ones, (B, A)."""
        self.seen.append(observations)
        return np.ones((len(observations), len(self.spec.actuated)))


def resting(count: int) -> tuple[FloatArray, FloatArray]:
    position = np.zeros((count, 18))
    position[:, 2], position[:, 6:] = 0.26, GO2.default_position
    return position, np.zeros_like(position)


def start(population: PopulationDemonstration, count: int) -> None:
    """Begin anew with robots that have no past."""
    past = np.empty((0, 18))
    population.restart(count, past, past, np.empty((0, 12)), 0)


def test_a_restart_forgets_and_members_that_diverged_rest() -> None:
    """The second rollout equals the first; a member that is NaN is sent the default pose again."""
    population = PopulationDemonstration(Leap(walk_spec(GO2)), GO2, WALK)
    position, velocity = resting(3)
    runs = []
    for _ in range(2):
        start(population, 3)
        runs.append([population(position, velocity) for _ in range(3)])
    first, again = runs
    np.testing.assert_array_equal(first, again)
    calf = GO2.actuated.index("FL_calf_joint")
    # -1.8 + 0.5 after one tick; 0.6, the whole scale, after two.
    np.testing.assert_allclose([a[0, calf] for a in first], [-1.3, -1.2, -1.2])
    position[1] = np.nan
    start(population, 3)
    sent = [population(position, velocity) for _ in range(2)]
    np.testing.assert_array_equal(sent[1][1], GO2.default_position)
    np.testing.assert_array_equal(sent[1][0], first[1][0])


def test_the_wish_is_observed() -> None:
    """A wanted speed of 0.4 m/s arrives at the policy."""
    policy = Leap(walk_spec(GO2))
    position, velocity = resting(1)
    Demonstration(policy, GO2, WALK)(position[0], velocity[0], 0.0)
    reported = [term.quantity for term in policy.spec.observation].index("command")
    assert policy.seen[0][0, reported] == pytest.approx(0.4)


def test_actions_are_clipped_and_limited() -> None:
    """2 becomes 1; a step of 0.5 rad at a scale of 0.8 is one of 0.625."""
    scale = np.full(12, 0.8)
    far = limited_action(GO2, scale, np.full(12, 2.0), np.full(12, 0.9))
    np.testing.assert_allclose(far, 1.0)
    np.testing.assert_allclose(limited_action(GO2, scale, np.full(12, -2.0), np.zeros(12)), -0.625)


def test_a_policy_for_another_robot_is_refused() -> None:
    """The cart-pole's policy does not drive a Go2."""
    with pytest.raises(PolicyMismatchError, match="'cartpole'"):
        Demonstration(demonstration_policy("cartpole"), GO2)


def test_a_checkpoint_tells_policies_and_wishes_apart(tmp_path: Path) -> None:
    """The digest of a search with pi_0 in the loop depends on the policy and on its commands."""
    ant = PopulationDemonstration(demonstration_policy("ant"), robot_description("ant"))
    made = [
        PopulationDemonstration(demonstration_policy("go2"), GO2, wanted)
        for wanted in (WALK, (0.0, 0.0, 0.0))
    ]
    assert len({digest(ant), digest(made[0]), digest(made[1])}) == 3
    again = PopulationDemonstration(demonstration_policy("go2"), GO2, WALK)
    start(again, 2)
    again(*resting(2))
    assert digest(again) == digest(made[0])


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["allegro", "humanoid"])
def test_shipped_policies_do_their_tasks(robot: str) -> None:
    """16 robots of the distribution: the humanoid walks, and the hand turns most cubes to their targets."""
    path = shipped_policy(robot)
    assert path is not None
    policy, record = OnnxPolicy(path), json.loads(path.with_suffix(".json").read_text())
    assert record["spec_digest"] == policy.spec.digest()
    assert record["onnx_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert record["curve"][-1]["steps"] == record["reached"]["steps"]
    env = training_task(robot).make(robot_description(robot), udr_distribution(robot), 16)
    found, still = judge(policy, env, 1), record["at_rest"]
    if robot == "humanoid":
        assert found["fall_rate"] < 0.5 < found["forward_speed_m_s"]
        assert still["fall_rate"] > 0.9
    else:
        assert found["fall_rate"] < 0.2 and found["outcomes"]["aligned"] > 0.6
        assert still["outcomes"]["aligned"] < 0.35
