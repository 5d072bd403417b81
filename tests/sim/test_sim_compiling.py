"""A user's MJCF, damaged or hostile: one line, in bounded time and memory."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine import compiling
from deal_hw.sim.engine.compiling import compile_mjcf, load_mjcf, problem_of
from deal_hw.sim.mjcf.joint_facts import joint_facts

JOINT = "<body><joint name='j'/><geom size='.1'/></body>"
PILE = "".join(f"<body pos='0 0 {i / 1000}'><freejoint/><geom size='.1'/></body>" for i in range(60))
"""Sixty spheres in one place: each touches each."""


def write(folder: Path, inside: str) -> Path:
    """Write a model and return its path."""
    path = folder / "robot.xml"
    path.write_text(f"<mujoco>{inside}</mujoco>", encoding="utf-8")
    return path


HOSTILE = {
    "no XML": ("<worldbody", "does not compile: XML parse error"),
    "include": ("<include file='nothere.xml'/>", "does not compile: .*nothere.xml"),
    "mesh": ("<asset><mesh name='a' file='nothere.stl'/></asset>", "does not compile: .*nothere.stl"),
    "not a number": (
        "<worldbody><body pos='nan 0 0'><joint/><geom size='1'/></body></worldbody>",
        "holds a number that is not finite",
    ),
    "timestep": (f"<option timestep='0'/><worldbody>{JOINT}</worldbody>", "has a timestep of 0 s"),
    "arena": (f"<size memory='100K'/><worldbody>{PILE}</worldbody>", "cannot be simulated: .*<size memory"),
    "unstable": (
        f"<worldbody>{JOINT}</worldbody><actuator><general joint='j' biastype='affine' "
        "biasprm='1e25 0 0'/></actuator>",
        "diverges in its first 10 steps",
    ),
    "depth": ("<worldbody>" + "<body>" * 3000 + "</body>" * 3000 + "</worldbody>", "nesting is too deep"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_cannot_be_used_is_one_line(tmp_path: Path, name: str) -> None:
    """What is wrong, in one line of bounded length; the same words that the separate process answers."""
    inside, words = HOSTILE[name]
    problem = problem_of(str(write(tmp_path, inside)))
    assert "\n" not in problem and len(problem) < 500
    assert re.search(words, problem)


def test_a_hostile_model_does_not_cost_our_memory(tmp_path: Path) -> None:
    """A texture of ten thousand million pixels in 200 bytes is refused by the process that tries it."""
    texture = "<texture name='t' type='2d' builtin='flat' width='100000' height='100000'/>"
    path = write(tmp_path, f"<asset>{texture}</asset><worldbody>{JOINT}</worldbody>")
    with pytest.raises(
        ConfigurationError, match=r"robot\.xml (cannot be compiled|does not compile)"
    ) as caught:
        compile_mjcf(path)
    assert "\n" not in str(caught.value)


def test_a_pile_is_refused_by_every_door(tmp_path: Path) -> None:
    """Contacts that overflow the arena end `data import --model` and `calibrate --model` alike."""
    path = write(tmp_path, f"<size memory='100K'/><worldbody>{JOINT}{PILE}</worldbody>")
    for door in (compile_mjcf, joint_facts):
        with pytest.raises(ConfigurationError, match="cannot be simulated"):
            door(path)


def test_a_pipe_and_a_folder_are_no_models(tmp_path: Path) -> None:
    """A pipe that nobody writes to would be waited for without end."""
    os.mkfifo(tmp_path / "pipe.xml")
    for path in (tmp_path / "pipe.xml", tmp_path, tmp_path / "nothere.xml"):
        with pytest.raises(ConfigurationError, match=str(path)):
            compile_mjcf(path)


def test_good_models_compile_and_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The model that was tried is the model that comes; MuJoCo's log is not in the user's folder."""
    monkeypatch.chdir(tmp_path)
    assert compile_mjcf(DESCRIPTION.mjcf).nq == load_mjcf(DESCRIPTION.mjcf).nq == 2
    assert not list(tmp_path.iterdir())


def test_a_sound_text_is_tried_once_and_what_names_other_files_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under any name; a changed text is another one, and an included file may have changed."""
    tried: list[str] = []
    monkeypatch.setattr(compiling, "_sound", set())
    monkeypatch.setattr(compiling, "_try", lambda path: tried.append(path.name))
    (tmp_path / "part.xml").write_text(f"<mujoco><worldbody>{JOINT}</worldbody></mujoco>", encoding="utf-8")
    path = write(tmp_path, f"<worldbody>{JOINT}</worldbody>")
    (tmp_path / "copy.xml").write_bytes(path.read_bytes())
    for name in ("robot.xml", "robot.xml", "copy.xml"):
        assert compile_mjcf(tmp_path / name).njnt == 1
    assert tried == ["robot.xml"]
    for inside in ("<worldbody/>", "<include file='part.xml'/>", "<include file='part.xml'/>"):
        compile_mjcf(write(tmp_path, inside))
    assert tried == ["robot.xml"] * 4


def test_a_text_that_failed_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what was sound is remembered: a second call does not compile a bad model in this process."""
    monkeypatch.setattr(compiling, "_sound", set())
    path = write(tmp_path, HOSTILE["timestep"][0])
    for _ in range(2):
        with pytest.raises(ConfigurationError, match=HOSTILE["timestep"][1]):
            compile_mjcf(path)
