"""`train --env`: a Gymnasium environment of a user, under a calibrated distribution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.cli.main import EXIT_OK, main
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policies.own_env import OwnVectorEnv
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.in_place import ModelInPlace
from deal_hw.workflows.robot import described

MJCF = """
<mujoco model="swing"><compiler angle="radian"/><option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="rod"><joint name="pivot" axis="0 1 0" damping="0.1" range="-1 1" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.01" mass="0.2"/></body></worldbody>
  <actuator><position name="motor" joint="pivot" kp="4" kv="0.05" forcerange="-3 3" ctrlrange="-1 1"
    ctrllimited="true"/></actuator>
</mujoco>
"""
FAULTS = ("observation", "action", "rate", "scalar", "model")


class Swing(gymnasium.Env[Any, Any]):
    """Bring a rod to 0.3 rad; observes position and velocity, and takes the servo's target."""

    def __init__(self, fault: str = "", spec: Any = None) -> None:
        self.model = mujoco.MjModel.from_xml_string(MJCF)
        self.data = mujoco.MjData(self.model)
        if fault == "model":
            del self.model
        self._fault = fault
        if spec is not None:
            self.policy_spec = spec
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, () if fault == "scalar" else (1,), np.float64)

    def _seen(self) -> Any:
        shift = 0.5 if self._fault == "observation" else 0.0
        return np.concatenate([self.data.qpos + shift, self.data.qvel])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self._left = 50
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.data.ctrl[:] = 0.5 * action if self._fault == "action" else action
        for _ in range(3 if self._fault == "rate" else 2):
            mujoco.mj_step(self.model, self.data)
        self._left -= 1
        return self._seen(), -float(abs(self.data.qpos[0] - 0.3)), False, self._left == 0, {}


SPEC = PolicySpec(
    robot="swing",
    joint_names=("pivot",),
    actuated=("pivot",),
    observation=tuple(
        ObservationTerm(quantity=q, joint="pivot", scale=1.0) for q in ("position", "velocity")
    ),
    action_scale=(0.5,),
    default_position=(0.0,),
    stiffness=(4.0,),
    damping=(0.05,),
    effort_limit=(3.0,),
    speed_limit=(1.0,),
    control_rate_hz=50.0,
)
KINDS: dict[str, dict[str, Any]] = {
    "": {},
    "Spec": {"spec": SPEC, "fault": "observation"},
    "Wrong": {"spec": "a text"},
    **{fault: {"fault": fault} for fault in FAULTS},
}
for name, arguments in KINDS.items():
    gymnasium.register(f"Swing{name}-v0", lambda **given: Swing(**given), kwargs=arguments)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rod's robot.yaml."""
    folder = tmp_path_factory.mktemp("swing")
    (folder / "swing.xml").write_text(MJCF, encoding="utf-8")
    return deal_hw.new_robot(folder / "swing.xml")


def spread(latency_s: float = 0.0) -> ParameterDistribution:
    """Return a distribution of damping and gain that is off the model's values."""
    rows = (("pivot.damping", "dof_damping", "pivot", 0.1), ("motor.gain", "servo_stiffness", "motor", 4.0))
    space = ParameterSpace([Parameter.around(n, kind, (element,), "", v) for n, kind, element, v in rows])
    covariance = 0.01 * np.eye(2)
    latency = (latency_s, latency_s)
    return ParameterDistribution(
        space=space, mean=np.array([0.3, 6.0]), covariance=covariance, latency_s=latency
    )


def swing_of(env: OwnVectorEnv, number: int) -> Swing:
    """Return a member as it was written."""
    found = env.envs[number].unwrapped
    assert isinstance(found, Swing)
    return found


def test_each_reset_draws_parameters_into_the_model(robot: Path) -> None:
    """Members differ, episodes differ, a seed fixes all; an episode that ends starts anew with others."""
    description = described(str(robot))
    env = OwnVectorEnv("Swing-v0", description, spread(), 3)
    models = [swing_of(env, n).model for n in range(3)]

    def values() -> list[tuple[float, float, float]]:
        return [(m.dof_damping[0], m.actuator_gainprm[0, 0], m.actuator_biasprm[0, 1]) for m in models]

    env.reset(seed=5)
    first = values()
    assert len(set(first)) == 3 and all(gain == -bias for _, gain, bias in first)
    # The mean is three times the model's damping; a hundredth is the variance of the logarithm.
    assert all(0.15 < damping < 0.6 for damping, _, _ in first)
    env.reset(seed=5)
    assert values() == first
    for _ in range(50):
        seen, _, _, truncated, info = env.step(np.zeros((3, 1)))
    assert truncated.all() and info["final_obs"][0].shape == (2,) and seen.dtype == np.float32
    assert values() != first


@pytest.mark.parametrize(("latency_s", "late"), [(0.0, 0), (0.045, 2)])
def test_an_action_is_a_target_that_acts_late(robot: Path, latency_s: float, late: int) -> None:
    """1 is the end of position_range; 45 ms are two steps of 20 ms."""
    env = OwnVectorEnv("Swing-v0", described(str(robot)), spread(latency_s), 1)
    env.reset(seed=0)
    controls = []
    for action in (1.0, -0.5, 0.25, 0.0):
        env.step(np.array([[action]]))
        controls.append(float(swing_of(env, 0).data.ctrl[0]))
    assert controls == [0.0] * late + [1.0, -0.5, 0.25, 0.0][: 4 - late]


@pytest.mark.slow
def test_a_policy_is_trained_and_exported(robot: Path, tmp_path: Path) -> None:
    """Both trainers; the file says robot, terms and scale."""
    for trainer, steps in (("sac", 1_200), ("ppo", 2_000)):
        words = ["--env", "Swing-v0", "--nominal", "--steps", str(steps), "--members", "4", "--quiet"]
        line = ["train", str(robot), *words, "--trainer", trainer, "--out", str(tmp_path / f"{trainer}.onnx")]
        assert main(line) == EXIT_OK
        policy = OnnxPolicy(tmp_path / f"{trainer}.onnx")
        policy.spec.check_fits(described(str(robot)))
        assert [term.quantity for term in policy.spec.observation] == ["position", "velocity"]
        assert policy.spec.action_scale == (1.0,) and policy.spec.training["algorithm"] == trainer


def test_a_failure_in_the_last_step_is_no_timeout(robot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ends at once: trainers would give the failed state the value of going on."""
    step = Swing.step

    def failing(self: Swing, action: Any) -> Any:
        seen, reward, _, truncated, info = step(self, action)
        return seen, reward, truncated, truncated, info

    env = OwnVectorEnv("Swing-v0", described(str(robot)), spread(), 1)
    env.reset(seed=0)
    monkeypatch.setattr(Swing, "step", failing)
    ends = [env.step(np.zeros((1, 1)))[2:4] for _ in range(50)]
    assert [bool(end[0]) for end in ends[-1]] == [True, False]
    assert not any(end[0] for both in ends[:-1] for end in both)


def test_an_environment_may_say_itself_what_it_observes(robot: Path) -> None:
    """Then nothing is tried, and its actions are the policy's."""
    env = OwnVectorEnv("SwingSpec-v0", described(str(robot)), spread(), 2)
    assert env.layout.action_scale == (0.5,) and env.layout.trained_under == spread().digest()
    env.reset(seed=0)
    env.step(np.full((2, 1), 0.7))
    assert swing_of(env, 0).data.ctrl[0] == 0.7


WRONG: list[tuple[str, str]] = [
    ("Swingobservation-v0", "does not observe the 1 joint positions"),
    ("Swingaction-v0", "does not write its actions unchanged into the actuators' ctrl"),
    ("Swingrate-v0", "makes 33.3333 steps a second, robot 'swing' takes 50 commands; correct frame_skip"),
    ("Swingscalar-v0", "must each be a Box of one dimension"),
    ("Swingmodel-v0", "is no MuJoCo environment"),
    ("SwingWrong-v0", "its policy_spec must be a deal_hw.policy.PolicySpec"),
    ("nowhere.at.all:Swing-v0", "write module:ENV_ID, such as my_robot.envs:Reach-v0"),
    ("Nosuch-v0", "write module:ENV_ID"),
]


@pytest.mark.parametrize(("env", "words"), WRONG, ids=[env for env, _ in WRONG])
def test_an_environment_that_cannot_be_used(robot: Path, env: str, words: str, tmp_path: Path) -> None:
    """It is refused before anything is trained, with what to change."""
    with pytest.raises(ConfigurationError) as raised:
        deal_hw.train(str(robot), env=env, nominal=True, out=tmp_path / "p.onnx", steps=1_200)
    assert words in str(raised.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"robot": "cartpole", "nominal": True}, "'env'.*`train robot.yaml` has it"),
        ({"udr": True}, "'udr'.*`train so101` have it"),
        ({}, "no distribution is named"),
    ],
)
def test_what_env_does_not_go_with(robot: Path, given: dict[str, Any], words: str) -> None:
    """Said at once."""
    with pytest.raises(ConfigurationError, match=words):
        deal_hw.train(**{"robot": str(robot), "env": "Swing-v0", **given})


def test_what_no_model_holds_is_refused() -> None:
    """An encoder's bias, and names that the model lacks."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    bias = Parameter(
        name="b",
        kind="encoder_bias",
        elements=("pivot",),
        unit="rad",
        nominal=0.0,
        low=-1,
        high=1,
        scale="linear",
    )
    with pytest.raises(ConfigurationError, match="parameters b act on commands and measurements"):
        ModelInPlace(model, ParameterSpace([bias]))
    other = Parameter.around("d", "dof_damping", ("knee",), "", 0.1)
    with pytest.raises(UnknownNameError, match="knee"):
        ModelInPlace(model, ParameterSpace([other]))
