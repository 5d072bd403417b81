"""Every option of the verbs that reach a robot changes what they do, or is refused; every option is read."""

from __future__ import annotations

import ast
import dataclasses
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from verb_options import Option, dataclasses_of, kind_of, options

from deal_hw.cli.main import parse
from deal_hw.cli.verbs import VERBS
from deal_hw.clock import VirtualClock
from deal_hw.control.process.channel import Outcome
from deal_hw.errors import DealHwError
from deal_hw.robots import driver_description
from deal_hw.robots.connect import make_robot
from deal_hw.types import Trajectory
from deal_hw.workflows import collect, deploy, replay
from deal_hw.workflows.doctor import examine
from deal_hw.workflows.running.report import EpisodeReport, RunReport

ROOT = Path(__file__).resolve().parents[2]
ZENOH = "--transport zenoh --port tcp/127.0.0.1:7447"
LINES = (
    "collect cartpole --port p --out o",
    "collect cartpole --port p --out o --motion chirp",
    "collect cartpole --port p --out o --motion hold",
    "collect go2 --port lo --out o --motion hold",
    f"collect go2_on_stand {ZENOH} --out o",
    "collect b2 --port lo --out o --motion hold",
    "collect g1 --port lo --out o --motion hold",
    "collect h1 --port lo --out o --motion hold",
    "deploy cartpole --port p",
    "deploy cartpole --port p --out o --dry-run",
    "deploy go2 --port lo",
    "deploy b2 --port lo --policy walk.onnx",
    f"deploy g1_23dof {ZENOH} --policy walk.onnx",
    f"deploy h1 {ZENOH} --policy walk.onnx",
    f"deploy go2 {ZENOH} --no-record",
    "replay e --port p",
    "replay e --port lo --robot go2",
    "replay e --port lo --robot g1 --hung-on-crane",
    "replay e --port lo --robot h1 --hung-on-crane",
    f"replay e {ZENOH} --robot go2 --stand False",
    "doctor",
    "doctor cartpole --port p",
    "doctor go2 --port lo",
    "doctor b2 --port lo",
    "doctor g1 --port lo",
    "doctor h1 --port lo",
    f"doctor go2 {ZENOH} --simulator unitree_mujoco",
)
VALUES: dict[str, tuple[str, ...]] = {
    "robot": ("go2_on_stand",),
    "transport": ("zenoh",),
    "port": ("p2",),
    "excite": ("multisine",),
    "velocity": ("0.1,0,0",),
    "obstacle": ("1,0.1",),
    "stop_buttons": ("R2+A",),
    "stand": ("False",),
    "task": ("balance",),
    "out": ("o2",),
    "dataset": ("d2",),
    "policy": ("other.onnx",),
    "json": ("findings.json",),
    "ca": ("ca.pem",),
    "certificate": ("c.pem",),
    "key": ("k.pem",),
    "reveal_to": ("truth.json",),
    "say": (),
    "mode": ("peer",),
}
"""What options that are no numbers, flags and choices are given."""
COMPOSED = (("", "_after_s"),)
"""Beginnings and ends of names that the emulator of the Go2 composes."""
TOLD_ELSEWHERE = {"quiet", "json"}
"""They change what is printed or written of the result, which the tests of each verb look at."""


def cases() -> Iterator[Any]:
    """Yield each line with each option that is not in it."""
    for line in LINES:
        verb, *words = line.split()
        config = getattr(importlib.import_module(VERBS[verb].module), VERBS[verb].config)
        values = {**VALUES, "stand": ("True",)} if "go2_on_stand" in line else VALUES
        for option in options(kind_of(config, *words), values):
            if option.name not in TOLD_ELSEWHERE and not {option.flag, *option.words[:1]} & set(words):
                yield pytest.param(line, option, id=f"{line} {option.name}")


def recorded() -> Trajectory:
    """Return a recording of a cart-pole with two commands."""
    facts = driver_description("cartpole")
    flat, joints = np.zeros((2, 1)), np.zeros((3, 2))
    return Trajectory(
        joint_names=facts.joint_names,
        actuated=facts.actuated,
        receive_s=np.arange(3.0),
        device_s=np.arange(3.0),
        position=joints,
        velocity=joints,
        effort=joints,
        status=np.zeros(3, np.int64),
        command_sequence=np.zeros(3, np.int64),
        command_age_s=np.zeros(3),
        sent_s=np.arange(2.0),
        sent_sequence=np.arange(2),
        requested_position=flat,
        position_target=flat,
        stiffness=flat,
        damping=flat,
        effort_limit=flat,
        speed_limit=flat,
        events=(),
        metadata={"robot": "cartpole"},
    )


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a verb did at the end: which robot it made, with which plan, and where it recorded."""
    did: list[Any] = []

    def run_episodes(plan: Any, *, port: str, **others: Any) -> RunReport:
        # The same call as the supervisor's: a driver or a wire refuses settings that it does not have.
        make_robot(plan.robot, plan.transport, port, VirtualClock(), plan.wire, plan.robot_settings)
        others.pop("view")
        did.append((plan.to_json(), port, others))
        ended = EpisodeReport(
            path=None, outcome=Outcome.STOPPED, reason="the run was stopped", passive_confirmed=True
        )
        return RunReport(dataset=None, episodes=(ended,))

    def behaviour(trajectory: Trajectory, description: Any) -> Any:
        return type("Replayed", (), {"duration_s": 2.0})()

    for module in (collect, deploy, replay):
        monkeypatch.setattr(module, "run_episodes", run_episodes)
    monkeypatch.setattr(replay, "read_trajectory", lambda path: recorded())
    monkeypatch.setattr(replay, "ReplayBehaviour", behaviour)

    def examine_robot(*arguments: Any) -> Iterator[Any]:
        did.append([arguments[0], arguments[3]])
        return iter(())

    class Listener:
        def __init__(self, link: Any, clock: Any, seconds: float, **others: Any) -> None:
            did.append((seconds, sorted(others.items())))

        def run(self) -> Iterator[Any]:
            return iter(())

    def made(*arguments: Any) -> Any:
        did.append([value for value in arguments if not hasattr(value, "now_ns")])
        from deal_hw.robots import connect, is_known

        kind = connect.make_robot if is_known(arguments[0]) else connect.make_topic_transport
        return kind(*arguments)

    monkeypatch.setattr(examine, "make_robot", made)
    monkeypatch.setattr(examine, "make_topic_transport", made)
    monkeypatch.setattr(examine, "examine_robot", examine_robot)
    monkeypatch.setattr(examine, "examine_machine", lambda: iter(()))
    monkeypatch.setattr(examine, "judge_interfaces", lambda port: iter(()))
    monkeypatch.setattr("deal_hw.drivers.go2.doctor.Go2Doctor", Listener)
    monkeypatch.setattr("deal_hw.drivers.b2.doctor.B2Doctor", Listener)
    monkeypatch.setattr("deal_hw.drivers.g1.doctor.G1Doctor", Listener)
    monkeypatch.setattr("deal_hw.drivers.h1.doctor.H1Doctor", Listener)
    return did


def outcome(done: list[Any], words: list[str]) -> Any:
    """Return what a verb did with some words, or the refusal."""
    done.clear()
    try:
        settings, function = parse(words[0], words[1:])
        function(settings)
    except DealHwError as error:
        return error
    return repr(done)


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    """What the lines do by themselves, as they are come to."""
    return {}


@pytest.mark.parametrize(("line", "option"), list(cases()))
def test_an_option_changes_something_or_is_refused(
    line: str, option: Option, done: list[Any], plain: dict[str, Any]
) -> None:
    """In this combination. The lines themselves are not refused."""
    if line not in plain:
        plain[line] = outcome(done, line.split())
    assert not isinstance(plain[line], DealHwError), plain[line]
    changed = outcome(done, [*line.split(), *option.words])
    assert isinstance(changed, DealHwError) or changed != plain[line], f"{' '.join(option.words)} did nothing"


def test_every_option_of_every_verb_is_read() -> None:
    """As an attribute, or by its name in a list of names: an option that nobody reads does nothing.

    Another thing of the same name would hide one. Names that the emulators compose count as read.
    """
    read: set[str] = set()
    for folder in ("deal_hw", "drivers", "policies", "calib"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                    read.add(node.attr)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    read.add(node.value)
    unread = {
        f"{verb} {entry.name}"
        for verb, found in VERBS.items()
        for settings in dataclasses_of(getattr(importlib.import_module(found.module), found.config))
        for entry in dataclasses.fields(settings)
        if entry.name not in read
        and not any(entry.name.startswith(a) and entry.name.endswith(b) for a, b in COMPOSED)
    }
    assert unread == set()
