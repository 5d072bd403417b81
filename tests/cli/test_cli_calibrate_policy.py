"""Methods that run the recordings' policy in every simulator: where it comes from, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from deal_hw.cli.calibrate import CalibrateDataset, CalibrateFiles, calibrate
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.errors import ConfigurationError, DatasetError, InsufficientDataError, UnknownNameError
from deal_hw.policies.demonstration import PopulationDemonstration
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.policy import say_other_range
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.running.plan import RunPlan, check_plan, make_behaviour
from deal_hw.workflows.shipped import shipped_policy
from deal_hw.workflows.train import udr_distribution

POLICY = shipped_policy("cartpole") or Path()


def record(folder: Path, *changes: Mapping[str, Any]) -> Path:
    """Record seconds of balancing for each set of changes to the metadata, as `collect` does."""
    plan = check_plan(
        RunPlan(robot="cartpole", motion="balance", seconds=2.4, policy=str(POLICY)), DESCRIPTION
    )
    with Dataset.create_or_open(folder, DESCRIPTION) as store:
        for change in changes:
            path = store.next_episode_path()
            metadata = {
                "motion": plan.motion,
                "purpose": "collect",
                "robot": "cartpole",
                "policy_digest": plan.policy_digest[:16],
                "velocity": plan.velocity,
                "stand": plan.stand,
            }
            robot = VirtualCartpole(nominal_truth("ideal", 4))
            robot.run(make_behaviour(plan, DESCRIPTION), plan.seconds, path, {**metadata, **change})
            store.note_episode(path)
        if changes and "policy_digest" not in changes[0]:
            store.keep_policy(POLICY, plan.policy_digest)
    return folder


def settings(folder: Path, **changes: Any) -> CalibrateDataset:
    """A calibration by the paper's method that is over in two generations."""
    values: dict[str, Any] = {
        "dataset": folder,
        "search": "deal-paper",
        "refine": False,
        "population": 6,
        "generations": 2,
        "advise": False,
        "report": False,
        "quiet": True,
        "free": ("cart.mass", "servo.stiffness"),
    }
    return CalibrateDataset(**{**values, **changes})


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One episode that its policy moved all the time, with the policy."""
    return record(tmp_path_factory.mktemp("run") / "dataset", {})


def test_the_datasets_own_policy_is_run(dataset: Path, tmp_path: Path) -> None:
    """Two generations end inside the ranges; a policy that is named is the same run."""
    found = [
        calibrate(settings(dataset, out=tmp_path / name, policy=policy)).result
        for name, policy in (("kept", None), ("named", POLICY))
    ]
    space = found[0].space
    assert np.all((space.low <= found[0].estimate) & (found[0].estimate <= space.high))
    assert found[0].latency_s == 0.0
    np.testing.assert_array_equal(found[0].estimate, found[1].estimate)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([{"motion": "rich"}], "episode 0 was recorded with motion 'rich'.*deal-paper-replay"),
        ([{"stand": True}], "episode 0 stands up and lies down"),
        ([{}, {"policy_digest": "0123456789abcdef"}], "recorded with 2 policies"),
        ([{"velocity": "keyboard"}], "one fixed velocity"),
        ([{"policy_digest": "0123456789abcdef"}], "has no copy.*0123456789abcdef.*--policy FILE"),
    ],
)
def test_recordings_that_one_policy_did_not_make_are_refused(
    tmp_path: Path, changes: list[dict[str, Any]], words: str
) -> None:
    """Each is reported before anything is simulated, with what to do."""
    folder = record(tmp_path / "dataset", *changes)
    with pytest.raises((InsufficientDataError, ConfigurationError), match=words):
        calibrate(settings(folder))


def test_another_policy_than_the_recordings_is_refused(dataset: Path) -> None:
    """Its digest is not that of the metadata."""
    other = shipped_policy("go2")
    with pytest.raises(ConfigurationError, match="is not the policy that moved the robot"):
        calibrate(settings(dataset, policy=other))


@pytest.mark.parametrize(
    ("range_ratio", "words"), [(None, ""), (3.0, "trained in another range of cart.mass, servo.stiffness.")]
)
def test_a_policy_of_another_range_is_said(dataset: Path, range_ratio: float | None, words: str) -> None:
    """Nothing is said where it was trained in the range that is searched."""
    printed: list[str] = []
    calibration_input(settings(dataset, range_ratio=range_ratio), say=printed.append)
    found = [line for line in printed if "The DEAL paper trains it" in line]
    assert len(found) == bool(words) and all(words in line for line in found)


def test_a_policy_of_another_training_is_said() -> None:
    """Its spec names another distribution."""
    other = SimpleNamespace(trained_under="0123456789abcdef")
    printed: list[str] = []
    space = udr_distribution("cartpole").space
    say_other_range(cast("PopulationDemonstration", other), "cartpole", space, printed.append)
    assert len(printed) == 1 and "another distribution than uniform randomisation" in printed[0]


def test_a_policy_that_would_do_nothing_is_refused(dataset: Path) -> None:
    """Methods without rollouts take none, and recordings of a model have none."""
    with pytest.raises(ConfigurationError, match="eki runs no policy"):
        calibrate(settings(dataset, search="eki", policy=POLICY))
    files = CalibrateFiles(model=Path("robot.xml"), data=(Path("a.csv"),), search="deal-paper")
    with pytest.raises(ConfigurationError, match="which is unknown for --model"):
        calibrate(files)


def test_start_states_of_a_method_without_a_policy_are_refused(dataset: Path) -> None:
    """They would do nothing; and a spread that no state is moved by."""
    with pytest.raises(ConfigurationError, match="--starts would have no effect: eki runs no policy"):
        settings(dataset, search="eki", starts="drawn").check()
    with pytest.raises(ConfigurationError, match="--start-std would have no effect: deal runs no policy"):
        settings(dataset, search=None, start_std=(("pole.velocity", 0.1),)).check()
    with pytest.raises(ConfigurationError, match="--starts recorded moves no state"):
        settings(dataset, starts="recorded", start_std=(("pole.velocity", 0.1),)).check()


def test_start_states_are_drawn_where_that_is_asked(dataset: Path, tmp_path: Path) -> None:
    """The result says so; an exact recording has them recorded otherwise, and names are checked."""
    drawn = calibrate(settings(dataset, out=tmp_path, start_std=(("pole.velocity", 0.1),))).result
    assert drawn.provenance["start_states"] == "drawn"
    assert drawn.provenance["start_std"] == {"pole.velocity": 0.1}
    plain = calibrate(settings(dataset, out=tmp_path)).result
    assert plain.provenance["start_states"] == "recorded"
    assert not np.array_equal(drawn.estimate, plain.estimate)
    with pytest.raises(UnknownNameError, match=r"pole\.speed"):
        calibrate(settings(dataset, out=tmp_path, start_std=(("pole.speed", 0.1),)))


def test_a_policy_is_kept_once_and_as_it_was_checked(tmp_path: Path) -> None:
    """The copy has the checked file's bytes; a file that was changed since is not kept."""
    digest = check_plan(RunPlan(robot="cartpole", policy=str(POLICY)), DESCRIPTION).policy_digest
    with Dataset.create_or_open(tmp_path / "dataset", DESCRIPTION) as store:
        kept = store.keep_policy(POLICY, digest)
        assert kept.read_bytes() == POLICY.read_bytes()
        assert store.keep_policy(tmp_path / "gone.onnx", digest) == kept
        with pytest.raises(DatasetError, match="was changed after it was checked"):
            store.keep_policy(POLICY, "0" * 64)
