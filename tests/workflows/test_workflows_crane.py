"""A robot that must hang on a crane: the operator's word before a run."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.g1.emulator.truth import nominal_truth
from deal_hw.errors import ConfigurationError, SafetyError
from deal_hw.robots.connect import make_robot
from deal_hw.workflows.collect import collect
from deal_hw.workflows.deploy import deploy
from deal_hw.workflows.emulation.hung import emulate_hung
from deal_hw.workflows.emulation.settings import EmulateG1Settings
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.settings import CraneOptions
from deal_hw.workflows.running.supervised import _conditioned
from deal_hw.workflows.running.view import RunView
from deal_hw.workflows.say import silent


class Operator(RunView):
    """Answers every question the same way, and notes the questions."""

    def __init__(self, answer: bool | None) -> None:
        super().__init__()
        self.answer, self.asked = answer, list[str]()

    def confirm(self, warning: str, question: str) -> bool | None:
        self.asked.append(f"{warning} {question}")
        return self.answer


def plan_of(robot: str, **more: object) -> tuple[RunPlan, Operator]:
    return RunPlan(robot=robot, transport="dds", motion="hold", port="lo", **more), Operator(True)  # type: ignore[arg-type]


def test_the_operators_word_goes_to_the_driver() -> None:
    """Yes on a terminal is the same as the option; with the option nobody is asked."""
    plan, operator = plan_of("g1")
    robot = make_robot("g1", "dds", "lo", VirtualClock())
    assert _conditioned(plan, robot, operator).robot_settings == {"hung_on_crane": True}
    assert len(operator.asked) == 1 and "must hang on a crane" in operator.asked[0]
    plan, operator = plan_of("g1", robot_settings={"hung_on_crane": True})
    assert _conditioned(plan, robot, operator) is plan and not operator.asked


def test_no_and_nobody_are_refusals() -> None:
    """No sends nothing; without a terminal the text names the option."""
    plan, _ = plan_of("g1_23dof")
    robot = make_robot("g1_23dof", "dds", "lo", VirtualClock())
    with pytest.raises(SafetyError, match="not run, nothing was sent"):
        _conditioned(plan, robot, Operator(False))
    with pytest.raises(SafetyError, match=r"No sensor tells it: confirm it by --hung-on-crane"):
        _conditioned(plan, robot, Operator(None))


def test_other_robots_and_dry_runs_are_not_asked() -> None:
    """A Go2 has no such condition; a dry run sends nothing."""
    plan, operator = plan_of("go2")
    assert _conditioned(plan, make_robot("go2", "dds", "lo", VirtualClock()), operator) is plan
    plan, operator = plan_of("g1", dry_run=True)
    assert _conditioned(plan, make_robot("g1", "dds", "lo", VirtualClock()), operator) is plan
    assert not operator.asked


def test_collect_and_deploy_ask_before_anything_is_opened(tmp_path: Path) -> None:
    """From Python nobody can answer: refused, and no folder is made; the port does not even exist."""
    with pytest.raises(SafetyError, match="crane"):
        collect("g1", port="no-such-interface", out=tmp_path / "run", motion="hold")
    assert not (tmp_path / "run").exists()
    with pytest.raises(Exception, match="no-such-interface"):
        collect(
            "g1",
            port="no-such-interface",
            out=tmp_path / "run",
            motion="hold",
            crane=CraneOptions(hung_on_crane=True),
        )
    with pytest.raises(Exception, match="policy"):
        deploy("g1", port="no-such-interface", crane=CraneOptions(hung_on_crane=True))


def test_a_truth_of_the_other_version_is_refused(tmp_path: Path) -> None:
    """A file of a g1 cannot emulate a g1_23dof: other joints."""
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(nominal_truth().to_json()), encoding="utf-8")
    settings = EmulateG1Settings("g1_23dof", truth_from=path)
    with pytest.raises(ConfigurationError, match=r"truth of a g1, not of a g1_23dof"):
        emulate_hung(settings, threading.Event(), threading.Event(), announce=silent, say=silent)
