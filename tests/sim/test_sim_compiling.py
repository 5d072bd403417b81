"""A user's MJCF, damaged or hostile: one line, in bounded time and memory."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fakes.waiting import until

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine import compiling
from deal_hw.sim.engine.compiling import compile_mjcf, problem_of
from deal_hw.sim.engine.model import load_model
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
    copy = tmp_path / "in" / "cartpole.xml"
    copy.parent.mkdir()
    copy.write_bytes(DESCRIPTION.mjcf.read_bytes())
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert compile_mjcf(copy).nq == compile_mjcf(DESCRIPTION.mjcf).nq == 2
    assert not list((tmp_path / "here").iterdir())


COPIES = f"<worldbody><replicate count='2000000000' offset='1 0 0'>{JOINT}</replicate></worldbody>"
"""A model that MuJoCo would compile for hours."""


def test_an_endless_model_ends_with_its_processor_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message says where to look; so do all verbs that load a robot from a file or a dataset."""
    monkeypatch.setattr(compiling, "SECONDS", 1)
    path = write(tmp_path, COPIES)
    with pytest.raises(ConfigurationError, match=r"not compiled after 1 s of processor time; .*a replicate"):
        compile_mjcf(path)
    with pytest.raises(ConfigurationError, match="not compiled after 1 s of processor time"):
        load_model(dataclasses.replace(DESCRIPTION, mjcf=path))


def children(pid: int) -> list[int]:
    """Return the process ids of a process's children."""
    found = Path(f"/proc/{pid}/task/{pid}/children")
    return list(map(int, found.read_text().split())) if found.exists() else []


def state(pid: int) -> str:
    """Return the state of a process as the kernel shows it, "" without such a process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


@pytest.mark.real_time
def test_the_process_that_tries_a_model_ends_with_its_parent(tmp_path: Path) -> None:
    """Also where nothing can be done any more: the parent is killed."""
    path = write(tmp_path, COPIES)
    program = f"from deal_hw.sim.engine.compiling import compile_mjcf; compile_mjcf({str(path)!r})"
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        try:
            until(lambda: children(parent.pid), "the process that tries the model starts")
            (child,) = children(parent.pid)
            until(lambda: "compiling" in Path(f"/proc/{child}/cmdline").read_text(), "it is the trial")
        finally:
            parent.kill()
    until(lambda: state(child) in ("", "Z", "X"), "the trial has ended")


def test_what_is_shipped_with_the_program_is_not_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Built-in robots start without another process; a link to a file elsewhere is not shipped."""
    tried: list[str] = []

    def counted(path: Path) -> list[str]:
        tried.append(path.name)
        return []

    monkeypatch.setattr(compiling, "_sound", {})
    monkeypatch.setattr(compiling, "_try", counted)
    load_model(DESCRIPTION)
    assert tried == []
    copy = tmp_path / "copy.xml"
    copy.write_bytes(DESCRIPTION.mjcf.read_bytes())
    load_model(dataclasses.replace(DESCRIPTION, mjcf=copy))
    assert tried == ["copy.xml"]


def test_a_sound_model_is_tried_again_when_a_file_of_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A text under any name; a changed text, or an included file that was changed, is another model."""
    tried: list[str] = []
    trial = compiling._try

    def counted(path: Path) -> list[str]:
        tried.append(path.name)
        return trial(path)

    monkeypatch.setattr(compiling, "_sound", {})
    monkeypatch.setattr(compiling, "_try", counted)
    part = tmp_path / "part.xml"
    part.write_text(f"<mujoco><worldbody>{JOINT}</worldbody></mujoco>", encoding="utf-8")
    path = write(tmp_path, f"<worldbody>{JOINT}</worldbody>")
    (tmp_path / "copy.xml").write_bytes(path.read_bytes())
    for name in ("robot.xml", "robot.xml", "copy.xml"):
        assert compile_mjcf(tmp_path / name).njnt == 1
    assert tried == ["robot.xml"]
    for inside in ("<worldbody/>", "<include file='part.xml'/>", "<include file='part.xml'/>"):
        compile_mjcf(write(tmp_path, inside))
    assert tried == ["robot.xml"] * 3
    part.write_text(f"<mujoco><worldbody>{JOINT} </worldbody></mujoco>", encoding="utf-8")
    compile_mjcf(path)
    assert tried == ["robot.xml"] * 4


def test_a_text_that_failed_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what was sound is remembered: a second call does not compile a bad model in this process."""
    monkeypatch.setattr(compiling, "_sound", {})
    path = write(tmp_path, HOSTILE["timestep"][0])
    for _ in range(2):
        with pytest.raises(ConfigurationError, match=HOSTILE["timestep"][1]):
            compile_mjcf(path)
