"""The verb `train`, called from Python."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import signal
import types
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import deal_hw.cli.main as cli
import deal_hw.cli.train as train_module
from deal_hw.cli.train import KINDS as TRAIN
from deal_hw.cli.train import train
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import VERDICT
from deal_hw.robots import driver_description
from deal_hw.sim.engine import warp_support
from deal_hw.training import TrainingProgress, TrainingStatus
from deal_hw.workflows.train import TrainSettings, read_distribution, udr_distribution

STEPS = 1_200
"""Enough for a few updates."""


def test_a_distribution_from_a_file_makes_a_policy_for_the_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The policy lies in the run folder, fits the robot and names the distribution; so does the record."""
    space = k9_space()
    distribution = ParameterDistribution(
        space=space, mean=space.nominal, covariance=0.01 * np.eye(len(space)), latency_s=(0.01, 0.012)
    )
    file = tmp_path / "distribution.json"
    file.write_text(json.dumps(distribution.to_json() | {"verdict": "amber"}), encoding="utf-8")
    training = train(
        TRAIN.settings(distribution=file, out=tmp_path, steps=STEPS, members=8, seed=4, quiet=True)
    )
    assert training.status is not None and training.first_return is not None
    now, first = training.status.mean_return, training.first_return
    reported = (
        f"return: {now:.1f}, at first {first:.1f}; {training.status.measures['time_up']:.0%} of an episode"
    )
    assert first < 0 and first != now and reported in capsys.readouterr().out
    assert f"{first:.4g}" in training.table()
    policy = OnnxPolicy(tmp_path / "policies" / "policy.onnx")
    policy.spec.check_fits(DESCRIPTION)
    assert policy.spec.trained_under == distribution.digest()
    assert policy.spec.training[VERDICT] == "amber"
    record = json.loads((tmp_path / "policies" / "policy.json").read_text(encoding="utf-8"))
    assert ParameterDistribution.from_json(record["distribution"]).digest() == distribution.digest()
    assert record["training"]["config"]["steps"] == STEPS
    assert record["training"]["members"] == 8
    assert record["seed"] == 4
    assert record["reward"].endswith("which has the effect of an alive bonus.")


def test_threads_change_no_policy(tmp_path: Path) -> None:
    """The same checkpoint with one thread and with two, and the record names the engine."""
    made = []
    for threads in (1, 2):
        training = train(
            TRAIN.settings(
                udr=True, trainer="ppo", out=tmp_path / str(threads), steps=STEPS, members=8, threads=threads,
                quiet=True,
            )
        )  # fmt: skip
        made.append(training.checkpoint.read_bytes())
        record = json.loads(training.record.read_text(encoding="utf-8"))
        assert record["engine"] == "mujoco"
    assert made[0] == made[1]


def test_a_gpu_that_is_not_there_is_said_before_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the remedy."""
    monkeypatch.setattr(warp_support, "gpu_problem", lambda: "no NVIDIA driver is installed")
    monkeypatch.setattr(warp_support, "find_spec", lambda name: True)
    with pytest.raises(ConfigurationError, match=r"needs a GPU, and no NVIDIA driver .* --engine mujoco"):
        train(TRAIN.settings(udr=True, engine="warp", out=tmp_path / "none"))
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_training_chooses_mujoco_without_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """--engine auto goes on, and says why."""
    monkeypatch.setattr(warp_support, "gpu_problem", lambda: "no NVIDIA driver is installed")
    monkeypatch.setattr(warp_support, "find_spec", lambda name: True)
    made = train(TRAIN.settings(udr=True, engine="auto", out=tmp_path, steps=STEPS, members=8))
    assert "mujoco simulates the training: --engine warp needs a GPU" in capsys.readouterr().err
    assert made.path.exists()


@pytest.mark.parametrize(
    ("engine", "gpu", "device"), [("warp", True, "cuda"), ("warp", False, "cpu"), ("mujoco", True, "cpu")]
)
def test_ppo_learns_where_the_robots_are_simulated(
    engine: str, gpu: bool, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU only if one simulates, and torch can use it."""
    import torch

    from deal_hw.policies.cartpole_env import CartPoleEnv
    from deal_hw.policies.ppo import learning_device
    from deal_hw.policies.vector_env import TaskKnowledge

    env = CartPoleEnv(DESCRIPTION, udr_distribution("cartpole"), 2)
    vars(env)["engine"] = engine
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert learning_device(env) == device
    assert learning_device(TaskKnowledge()) == "cpu"


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)")
def test_a_policy_of_warp_runs_on_mujoco(tmp_path: Path) -> None:
    """Two updates on its CPU device: the first observations agree, so the first returns nearly do."""
    made = [
        train(
            TRAIN.settings(
                udr=True,
                trainer="ppo",
                engine=engine,
                out=tmp_path / engine,
                steps=STEPS,
                members=16,
                quiet=True,
            )
        )
        for engine in ("mujoco", "warp-cpu")
    ]
    records = [json.loads(training.record.read_text(encoding="utf-8")) for training in made]
    assert [record["engine"] for record in records] == ["mujoco", "warp-cpu"]
    first = [training.first_return for training in made]
    assert first[0] is not None and first[1] == pytest.approx(first[0], rel=0.02)
    seen = np.zeros((1, len(made[1].policy.spec.observation)), dtype=np.float32)
    np.testing.assert_allclose(made[1].policy.act_batch(seen), made[0].policy.act_batch(seen), atol=0.05)


@pytest.mark.parametrize(("robot", "reported"), [("cartpole", True), ("ant", False)])
def test_the_next_line_runs_the_policy(
    robot: str, reported: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a robot that has a driver; a robot of the simulator alone cannot be deployed to."""
    monkeypatch.setattr(train_module, "train", lambda config: types.SimpleNamespace(path=Path("p.onnx")))
    train_module.train_and_say_next(TRAIN.settings(robot=robot, udr=True))
    line = f"next: deal-hw deploy {robot} --port PORT --policy p.onnx\n"
    assert capsys.readouterr().out == (line if reported else "")


def test_udr_covers_a_factor_of_five_and_30_ms() -> None:
    """Uniform domain randomisation is what calibration is compared with: its width is fixed."""
    distribution = udr_distribution("cartpole")
    np.testing.assert_allclose(distribution.space.high / distribution.space.nominal, 5.0)
    np.testing.assert_allclose(distribution.space.nominal / distribution.space.low, 5.0)
    assert distribution.covariance is None
    assert distribution.latency_s == (0.0, 0.03)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (TRAIN.settings(), r"no distribution is named: give --distribution FILE .*, --udr or --nominal"),
        (
            TRAIN.settings(udr=True, distribution=Path("x.json")),
            "--distribution and --udr exclude each other",
        ),
        (TRAIN.settings(udr=True, nominal=True), "--udr and --nominal exclude each other"),
        (
            TRAIN.settings(udr=True, resume=True, start=Path("x.safetensors")),
            "--start and --resume exclude each other",
        ),
        (
            TRAIN.settings(udr=True, resume=True, out=Path("none")),
            r"nothing to resume: none/policies/policy\.safe",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(config: TrainSettings, words: str) -> None:
    """The message says what to give or to leave out."""
    with pytest.raises(ConfigurationError, match=words):
        train(config)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_first_step_ends_at_once(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """While the libraries load there is nothing to keep; nothing is loaded or written after the signal."""
    after = []

    def load(*_: object, **__: object) -> None:
        signal.raise_signal(number)
        after.append("went on")

    monkeypatch.setattr("deal_hw.workflows.train.train_policy", load)
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt):
        train(TRAIN.settings(udr=True, out=tmp_path, quiet=True))
    assert not after and not list(tmp_path.iterdir())
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_a_loading_library_swallows_ends_it_all_the_same(
    number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It ended with a traceback, "ImportError: initialization failed"."""

    def load(*_: object, **__: object) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        raise ImportError("initialization failed")

    monkeypatch.setattr("deal_hw.workflows.train.train_policy", load)
    assert cli.main(["train", "cartpole", "--udr", "--quiet", "--out", str(tmp_path)]) == cli.EXIT_INTERRUPTED
    assert capsys.readouterr().err == "deal-hw: interrupted\n"


def test_a_go2_is_trained_stopped_and_resumed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C after the first update leaves policy, record, checkpoint and log; --resume does the rest."""
    seen: list[TrainingStatus] = []

    def follow(bar: object) -> TrainingProgress:
        def note(status: TrainingStatus) -> None:
            seen.append(status)
            if len(seen) == 1:
                signal.raise_signal(signal.SIGINT)

        return note

    monkeypatch.setattr(train_module, "_follow", follow)
    # Two updates of 24 ticks of 4 robots.
    config = TRAIN.settings(robot="go2", nominal=True, out=tmp_path, steps=192, members=4, quiet=True)
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(config)
    assert signal.getsignal(signal.SIGINT) is handler
    assert "stopped before the end; --resume continues" in capsys.readouterr().out
    policies = tmp_path / "policies"
    OnnxPolicy(policies / "policy.onnx").spec.check_fits(driver_description("go2"))
    record = json.loads((policies / "policy.json").read_text(encoding="utf-8"))
    assert record["training"]["algorithm"] == "ppo" and record["reached"]["steps"] == 96
    assert {"velocity_error_m_s", "yaw_error_rad_s", "falls_a_minute"} <= record["reached"]["measures"].keys()
    assert list((policies / "policy_tensorboard").iterdir())
    policy = train(dataclasses.replace(config, resume=True)).policy
    assert [status.steps for status in seen] == [96, 192]
    assert "return: " not in capsys.readouterr().out  # No episode has ended.
    whole = json.loads((policies / "policy.json").read_text(encoding="utf-8"))
    assert whole["resumed"] and whole["cpu_seconds"] > record["cpu_seconds"]
    tuned = dataclasses.replace(
        config, out=tmp_path / "tuned", start=policies / "policy.safetensors", steps=96
    )
    train(tuned)
    observation = np.zeros(len(policy.spec.observation), dtype=np.float32)
    again = OnnxPolicy(tmp_path / "tuned" / "policies" / "policy.onnx")
    assert np.abs(again.act(observation) - policy.act(observation)).max() < 0.2


def test_a_missing_distribution_names_the_verb_that_writes_it(tmp_path: Path) -> None:
    """The message names the path and `deal-hw calibrate`."""
    with pytest.raises(
        ConfigurationError, match=r"none\.json cannot be read: .*; `deal-hw calibrate` writes"
    ):
        read_distribution(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", " cannot be read as a parameter distribution"),
        ("[1]", " .*should be an object"),
        ('{"format": "other"}', ": not a parameter distribution: format is 'other'"),
        ('{"format": "deal_hw.parameter_distribution/1"}', ": field space is missing"),
    ],
)
def test_a_file_that_holds_no_distribution_is_refused(tmp_path: Path, text: str, words: str) -> None:
    """No JSON, other JSON and half a distribution give one error."""
    file = tmp_path / "bad.json"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=rf"bad\.json{words}"):
        read_distribution(file)


def test_an_unknown_robot_is_refused_by_name() -> None:
    """The message lists the robots that can be trained."""
    with pytest.raises(
        UnknownNameError,
        match=r"unknown robot with a training environment 'go3'; known: allegro, ant, cartpole, ",
    ):
        train(TRAIN.settings(robot="go3", udr=True, quiet=True))
