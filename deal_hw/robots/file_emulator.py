"""Emulated arms of servos on a pseudo-terminal, with hidden physics: of a robot.yaml, and the SO-101."""

from __future__ import annotations

from typing import Final

from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.connect import section_of
from deal_hw.drivers.servo_arm.emulator import arm_device
from deal_hw.drivers.so101.description import emulated_space
from deal_hw.drivers.so101.emulator import so101_device
from deal_hw.parameters import ParameterSpace
from deal_hw.robots.emulation import Emulation, EmulatorRequest, on_pseudo_terminal
from deal_hw.schema import from_values
from deal_hw.sim.robots.robot_file import RobotFile
from deal_hw.sim.robots.simulated import SimulatedTruth, default_space, draw_truth

RANGE_RATIO: Final = 1.5
"""As of `collect --simulated`: hidden parameters lie within this factor of the MJCF's."""
LATENCY_S: Final = 0.005
"""From a servo's goal to its effect in profiles other than ideal [s]; as of `collect --simulated`."""


def emulate_arm(file: RobotFile, description: RobotDescription, request: EmulatorRequest) -> Emulation:
    """Return an emulated arm of a robot.yaml behind a pseudo-terminal.

    Args:
        file: The robot, with its section ``hardware``.
        description: Its description.
        request: What was asked for.
    """
    space = default_space(description)
    truth = truth_of(space, request)
    noisy = request.profile != "ideal"
    section = section_of(file)
    device = arm_device(
        section,
        description,
        space,
        truth,
        faults=request.servos,
        noisy=noisy,
        joint_faults=request.joints,
    )
    return on_pseudo_terminal(device, request, truth.to_json())


def emulate_so101(request: EmulatorRequest) -> Emulation:
    """Return an emulated SO-101 behind a pseudo-terminal; its servos keep LeRobot's calibration."""
    truth = truth_of(emulated_space(), request)
    device = so101_device(
        truth, faults=request.servos, noisy=request.profile != "ideal", joint_faults=request.joints
    )
    return on_pseudo_terminal(device, request, truth.to_json())


def truth_of(space: ParameterSpace, request: EmulatorRequest) -> SimulatedTruth:
    """Return the hidden values that a request asks for: given ones, the nominal ones, or drawn ones."""
    if request.truth is not None:
        names = ("parameters", "latency_s", "seed")
        return from_values(SimulatedTruth, {name: request.truth.get(name) for name in names})
    latency_s = 0.0 if request.profile == "ideal" else LATENCY_S
    if request.nominal:
        values = {**space.known, **{p.name: p.nominal for p in space.parameters}}
        return SimulatedTruth(parameters=values, latency_s=0.0, seed=request.seed)
    ratio = RANGE_RATIO if request.range_ratio is None else request.range_ratio
    return draw_truth(space, request.seed, ratio, latency_s)
