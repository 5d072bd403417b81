"""The verb `design-excitation` and `collect --excite`: what is written, what is played and on what."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.design_excitation import KINDS as DESIGN_EXCITATION
from deal_hw.cli.design_excitation import design_excitation
from deal_hw.control.process.channel import Outcome
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.emulator.oracle import draw_truth
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, nominal_truth
from deal_hw.drivers.so101.description import DESCRIPTION as ARM
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.motions.excitation.plan import ExcitationBehaviour, read_plan
from deal_hw.workflows.collect import _excitation
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.running.plan import RunPlan, make_behaviour
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.shipped import shipped_policy

POLICY = str(shipped_policy("cartpole") or "")
TRUTHS: dict[str, Callable[[], CartpoleTruth]] = {
    "nominal": lambda: nominal_truth("sensor", 3, actuation_ticks=9),
    "drawn": lambda: draw_truth("sensor", 3, range_ratio=5.0),
}


@pytest.fixture(scope="module")
def optimal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An excitation that was searched for, in no time."""
    path = tmp_path_factory.mktemp("run") / "optimal.json"
    report = design_excitation(
        DESIGN_EXCITATION.settings(
            robot="cartpole",
            out=path,
            seconds=2.0,
            candidates=4,
            draws=2,
            confirm=2,
            rounds=2,
            threads=1,
            quiet=True,
        )
    )
    assert report.optimum is not None
    assert report.optimum.tried >= 3 + 4 + 2
    assert set(report.optimum.references) == {"multisine", "chirp", "rich"}
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An excitation of a family, which needs no search."""
    path = tmp_path_factory.mktemp("run") / "multisine.json"
    design_excitation(
        DESIGN_EXCITATION.settings(robot="cartpole", out=path, family="multisine", seconds=2.0, quiet=True)
    )
    return path


@pytest.mark.slow
def test_optimal_is_written_with_what_it_will_tell(optimal: Path) -> None:
    """The file holds a plan for this robot and a predicted spread for each of the nine parameters."""
    plan = read_plan(optimal)
    plan.check_fits(DESCRIPTION)
    assert len(plan.predicted) == 9
    assert all(0 < std < 1 for std in plan.predicted.values())


@pytest.mark.parametrize("name_of_truth", TRUTHS)
@pytest.mark.parametrize(
    "kind", ["multisine", "chirp", "steps", pytest.param("optimal", marks=pytest.mark.slow)]
)
def test_each_excitation_keeps_the_limits(
    kind: str, name_of_truth: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Recorded through driver, bytes and safety module: the run ends by itself, no command was clipped."""
    name = kind
    if kind == "optimal":
        name = str(request.getfixturevalue("optimal"))
    elif kind == "steps":
        name = str(tmp_path / "steps.json")
        settings = DESIGN_EXCITATION.settings(
            robot="cartpole",
            out=Path(name),
            family="steps",
            seconds=2.0,
            amplitude=0.5,
            effort=0.15,
            speed=2.5,
            quiet=True,
        )
        design_excitation(settings)
    plan = RunPlan(robot="cartpole", motion="excite", excite=name, policy=POLICY, seconds=2.0, seed=3)
    assert RunPlan.from_json(json.loads(json.dumps(plan.to_json()))) == plan
    run = VirtualCartpole(TRUTHS[name_of_truth]()).run(make_behaviour(plan, DESCRIPTION), plan.seconds)
    assert (run.report.outcome, run.report.clipped) == (Outcome.FINISHED, {})
    assert np.ptp(run.trajectory.position[:, 0]) > 0.02
    again = make_behaviour(plan, DESCRIPTION)
    assert isinstance(again, ExcitationBehaviour)


def test_seeds_give_other_multisines() -> None:
    """Episode k is recorded with SEED + k."""
    asked = []
    for seed in (0, 0, 1):
        plan = RunPlan(robot="so101", motion="excite", excite="multisine", seconds=10.0, seed=seed)
        behaviour = make_behaviour(plan, ARM)
        assert isinstance(behaviour, ExcitationBehaviour)
        asked.append(behaviour._plan.offsets(np.linspace(0, 10, 50)))
    np.testing.assert_array_equal(asked[0], asked[1])
    assert np.max(np.abs(asked[2] - asked[0])) > 0.05


def test_collect_finds_what_to_play(written: Path) -> None:
    """A family keeps SECONDS, a file says how long it is, no excitation leaves the profile."""

    def found(**settings: Any) -> tuple[str, float]:
        return _excitation(COLLECT.settings(robot="cartpole", port="x", **settings), RunView())

    assert found(excite="chirp", seconds=3.0) == ("chirp", 3.0)
    assert found(excite=str(written)) == (str(written), 2.0)
    assert found() == ("", 4.0)
    with pytest.raises(ConfigurationError, match="--out RUN"):
        found(excite="optimal")
    with pytest.raises(ConfigurationError, match="multisine, chirp, or a file"):
        found(excite="sine")


def test_files_that_do_not_fit_are_refused(written: Path, tmp_path: Path) -> None:
    """Another robot's, or of another length than the run."""
    with pytest.raises(ConfigurationError, match="made for robot 'cartpole'"):
        make_behaviour(RunPlan(robot="so101", motion="excite", excite=str(written), seconds=2.0), ARM)
    with pytest.raises(ConfigurationError, match="is 2 s long"):
        make_behaviour(
            RunPlan(robot="cartpole", motion="excite", excite=str(written), policy=POLICY, seconds=4.0),
            DESCRIPTION,
        )
    with pytest.raises(UnknownNameError, match="k99"):
        design_excitation(
            DESIGN_EXCITATION.settings(robot="cartpole", out=tmp_path / "x.json", space="k99", quiet=True)
        )


def test_playing_needs_no_extra(written: Path) -> None:
    """The control process plays a written excitation without torch, mujoco and scipy."""
    code = (
        "import sys; from deal_hw.workflows.running.plan import RunPlan, make_behaviour; "
        "from deal_hw.robots import robot_description; import deal_hw.cli.collect; "
        f"plan = RunPlan(robot='cartpole', motion='excite', excite={str(written)!r}, policy={POLICY!r}, "
        "seconds=2.0); make_behaviour(plan, robot_description('cartpole')); "
        "print([m for m in ('torch', 'mujoco', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"
