"""Trainings of several seeds, in this process and in Ray's workers."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import deal_hw
import deal_hw.cli.main as cli
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.train import TRAIN, Training
from deal_hw.workflows.train_seeds import of_seed

STEPS = 192
"""Two updates of 24 ticks of 4 robots."""


def test_each_seed_has_the_policy_that_it_has_alone(tmp_path: Path) -> None:
    """In a folder of its own; what others fine-tune from is equal to the last bit."""
    ended = dict[int, Training | str]()
    named: dict[str, Any] = {"udr": True, "trainer": "ppo", "steps": STEPS, "members": 4}
    found = deal_hw.train_seeds(
        "cartpole", seeds=(3, 0), ended=ended.__setitem__, out=tmp_path / "several", **named
    )
    assert list(found.trainings) == list(ended) == [3, 0] and not found.failed
    for seed, training in found.trainings.items():
        alone = deal_hw.train("cartpole", seed=seed, out=tmp_path / f"alone {seed}", **named)
        assert training.path == tmp_path / "several" / f"seed_{seed}" / "policies" / "policy.onnx"
        assert training.checkpoint.read_bytes() == alone.checkpoint.read_bytes()
    made = [one.checkpoint.read_bytes() for one in found.trainings.values()]
    assert made[0] != made[1]
    lines = found.table().splitlines()
    assert [line.split()[0] for line in lines] == ["seed", "3", "0"] and "seed_3" in lines[1]


def test_a_file_has_the_seed_in_its_name(tmp_path: Path) -> None:
    """Beside what was asked for; --resume is for those that have begun."""
    config = TRAIN.settings(udr=True, out=tmp_path / "walk.onnx", resume=True)
    own = of_seed(config, 7)
    assert (own.out, own.seed, own.resume) == (tmp_path / "walk_seed_7.onnx", 7, False)
    (tmp_path / "walk_seed_7.safetensors").touch()
    assert of_seed(config, 7).resume


def test_a_training_that_fails_does_not_end_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seed 0 resumes from a file that is no checkpoint; seed 1 was never begun."""
    broken = tmp_path / "seed_0" / "policies" / "policy.safetensors"
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"no checkpoint")
    options = ["--udr", "--trainer", "ppo", "--steps", str(STEPS), "--members", "4", "--out", str(tmp_path)]
    assert (
        cli.main(["train", "cartpole", *options, "--seeds", "0,1", "--resume", "--quiet"]) == cli.EXIT_ERROR
    )
    printed = capsys.readouterr()
    assert "seeds 0 failed" in printed.err
    rows = {line.split()[0]: line for line in printed.out.splitlines() if line[:1].isdigit()}
    assert "cannot be read" in rows["0"] and "policy.onnx" in rows["1"]
    assert (tmp_path / "seed_1" / "policies" / "policy.onnx").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--ray", "local"], "give --seeds, as 0-4"),
        (["--seeds", "0-1", "--seed", "3"], "--seed and --seeds exclude each other"),
        (["--seeds", "0,0"], "each once"),
        (["--seeds", "0-1", "--ray", "local", "--engine", "warp"], "would share one device"),
        (["--seeds", "0-1", "--ray", "here"], "--ray"),
        (["--seeds", "3-"], "--seeds"),
    ],
)
def test_what_cannot_be_is_refused_before_any_training(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is written."""
    out = tmp_path / "out"
    assert cli.main(["train", "cartpole", "--udr", "--out", str(out), *options]) != cli.EXIT_OK
    assert words in capsys.readouterr().err and not out.exists()


def test_no_distribution_is_said_before_workers_are_started(tmp_path: Path) -> None:
    """They take seconds to start."""
    with pytest.raises(ConfigurationError, match="no distribution is named"):
        deal_hw.train_seeds("cartpole", seeds=(0, 1), ray="local", out=tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("one_ray")
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed (extra scale)")
def test_workers_make_the_same_policies(tmp_path: Path) -> None:
    """With one thread of the numeric libraries here, as workers have."""
    base = ["--udr", "--trainer", "ppo", "--steps", str(STEPS), "--members", "4", "--seeds", "0-2"]
    for name, more in (("here", []), ("workers", ["--ray", "local:2"])):
        subprocess.run(
            [sys.executable, "-m", "deal_hw.cli.main", "train", "cartpole", *base, *more, "--out", name],
            cwd=tmp_path,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            check=True,
            timeout=300,
        )
    for seed in range(3):
        made = [
            (tmp_path / name / f"seed_{seed}" / "policies" / "policy.safetensors").read_bytes()
            for name in ("here", "workers")
        ]
        assert made[0] == made[1]
