"""One interface of simulators: windows at once or one by one, and which engine is taken, without a GPU."""

from __future__ import annotations

import ctypes
import dataclasses

import mujoco
import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.sim.engine import warp_support
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.gpu import WantedEngine, gpu_problem
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.warp_support import choose_engine, missing_features
from deal_hw.sim.recordings.episode import align
from deal_hw.sim.recordings.windows import _groups, cut_windows, predict_windows, setpoints

BODY = '<worldbody><body><joint name="hinge"/><geom size=".1"/></body></worldbody>'
FAR = 10_000


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """The cart-pole."""
    return load_model(DESCRIPTION)


def members(robot: RobotModel) -> ServoBatch:
    """Return three cart-poles that differ."""
    space = k9_space()
    batch = ServoBatch(robot, space, 3, threads=1)
    batch.set_parameters(space.unnormalize(np.random.default_rng(0).random((3, len(space)))))
    return batch


def test_windows_are_as_simulated_one_by_one(robot: RobotModel) -> None:
    """To the last bit, with forces: two windows of 20 steps, read after each fifth."""
    rng = np.random.default_rng(1)
    position, velocity = 0.05 * rng.standard_normal((2, 3, 2, 2))
    command, force = 0.1 * rng.standard_normal((3, 2, 20, 1)), rng.standard_normal((3, 2, 20, 2))
    x, v = members(robot).advance_windows((position, velocity), command, 5, force=force)
    alone = members(robot)
    for g in range(2):
        alone.set_state(position[:, g], velocity[:, g])
        one = alone.advance(command[:, g], 5, force=force[:, g])
        np.testing.assert_array_equal(x[:, g], one[0])
        np.testing.assert_array_equal(v[:, g], one[1])
    assert x.shape == (3, 2, 4, 2)


def test_all_windows_at_once_are_as_one_by_one(robot: RobotModel) -> None:
    """Whatever an engine takes at once, and where the sent gains change between windows."""
    space = k9_space()
    made = simulated_episode(DESCRIPTION, space, space.nominal, seconds=0.5)
    episode = align(made, DESCRIPTION)
    stiffer = episode.stiffness.copy()
    stiffer[len(stiffer) // 2 :] *= 1.2
    episode = dataclasses.replace(episode, stiffness=stiffer)
    windows = cut_windows(episode, 10)
    start = episode.position[windows.start], episode.velocity[windows.start]
    force = np.ones((3, len(windows), 10 * windows.stride, 2))
    found = []
    for most in (1, 2, FAR):
        batch = members(robot)
        vars(batch.engine)["windows"] = most
        path = setpoints(batch, episode, np.array([0.0, 0.005, 0.01]))
        found.append(predict_windows(batch, episode, windows, *start, path, force))
    assert len(windows) > 3
    for x, v in found[1:]:
        np.testing.assert_array_equal(x, found[0][0])
        np.testing.assert_array_equal(v, found[0][1])


def test_windows_at_once_have_equal_gains() -> None:
    """Five windows, the third with other gains, at most two at once."""
    a, b = (b"1", b"", b""), (b"2", b"", b"")
    assert [rows.tolist() for rows in _groups([a, a, b, a, a], 2)] == [[0, 1], [3, 4], [2]]


def test_what_warp_lacks_is_named_by_element() -> None:
    """A PID actuator and a delay: both in one line, with what to do."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco>{BODY}<actuator><pid name="servo" joint="hinge" kp="3" ki="1"/>
        <position joint="hinge" delay="0.01" nsample="5"/></actuator></mujoco>"""
    )
    with pytest.raises(ConfigurationError) as refused:
        warp_support.check_model(model)
    text = str(refused.value)
    assert "actuator servo has gain pid" in text and "delays of actuators" in text
    assert "use --engine mujoco" in text and "\n" not in text


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ('solver="PGS"', "solver PGS"),
        ('noslip_iterations="3" integrator="discrete"', "noslip with the integrator discrete"),
        ('noslip_iterations="3"', ""),
        ("", ""),
    ],
)
def test_options_that_warp_lacks(option: str, named: str) -> None:
    """Of the solver; noslip alone it has."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><option {option}/>{BODY}</mujoco>")
    assert missing_features(model) == ([named] if named else [])


class Driver:
    """CUDA's driver, as far as it is asked."""

    def __init__(self, code: int, devices: int) -> None:
        self._code, self._devices = code, devices

    def __call__(self, name: str) -> Driver:
        return self

    def cuInit(self, flags: int) -> int:  # noqa: N802
        return self._code

    def cuDeviceGetCount(self, count: object) -> int:  # noqa: N802
        ctypes.cast(count, ctypes.POINTER(ctypes.c_int))[0] = self._devices  # type: ignore[arg-type]
        return 0


@pytest.mark.parametrize(
    ("code", "devices", "words"),
    [
        (0, 1, ""),
        (0, 0, "no GPU"),
        (803, 0, "error 803 (its version is not the kernel's)"),
        (7, 0, "error 7"),
    ],
)
def test_the_driver_is_asked_for_a_gpu(
    monkeypatch: pytest.MonkeyPatch, code: int, devices: int, words: str
) -> None:
    """Without loading Warp."""
    monkeypatch.setattr(ctypes, "CDLL", Driver(code, devices))
    assert words in gpu_problem() and bool(gpu_problem()) == bool(words)


@pytest.mark.parametrize("wanted", ["auto", "warp"])
def test_without_a_driver_only_auto_goes_on(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch, wanted: WantedEngine
) -> None:
    """It says why; a wish for a GPU is refused with a remedy."""

    def missing(name: str) -> object:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", missing)
    monkeypatch.setattr(warp_support, "find_spec", lambda name: True)
    said: list[str] = []
    if wanted == "auto":
        assert choose_engine(wanted, robot, 100, "the search", said.append) == "mujoco"
        assert "no NVIDIA driver" in said[0]
    else:
        with pytest.raises(ConfigurationError, match=r"no NVIDIA driver .* --engine warp-cpu"):
            choose_engine(wanted, robot, 100, "the search", said.append)


@pytest.mark.parametrize(
    ("wanted", "population", "method", "engine", "words"),
    [
        ("mujoco", 1000, "", "mujoco", ""),
        ("auto", 1000, "", "warp", "on the GPU, in float32"),
        ("auto", 10, "", "mujoco", "10 members are too few"),
        ("auto", 1000, "local", "mujoco", "the method local has none"),
        ("warp", 10, "", "warp", "on the GPU, in float32"),
        ("warp-cpu", 10, "", "warp-cpu", "far slower"),
    ],
)
def test_the_engine_that_is_taken_is_said(
    robot: RobotModel,
    monkeypatch: pytest.MonkeyPatch,
    wanted: WantedEngine,
    population: int,
    method: str,
    engine: str,
    words: str,
) -> None:
    """With a GPU: auto takes it where the population is large enough, and the method has one."""
    monkeypatch.setattr(ctypes, "CDLL", Driver(0, 1))
    monkeypatch.setattr(warp_support, "find_spec", lambda name: True)
    said: list[str] = []
    assert choose_engine(wanted, robot, population, "the search", said.append, method) == engine
    assert words in "".join(said) and bool(said) == bool(words)


def test_a_missing_package_is_named_with_its_extra(
    robot: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As every extra."""
    monkeypatch.setattr(warp_support, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"warp-lang is not installed; .*gpu"):
        choose_engine("warp", robot, 100, "the search", lambda text: None)
