"""deal-hw: record a robot for seconds, calibrate its simulator, retrain, deploy, compare.

    import deal_hw

    with deal_hw.emulate("cartpole", seed=1) as robot:  # or a robot of yours on port="/dev/ttyUSB0"
        deal_hw.collect("cartpole", port=robot.port, out="runs/first")
        found = deal_hw.calibrate(dataset="runs/first/dataset")
        policy = deal_hw.train("cartpole", distribution=found, out="runs/first")
        deal_hw.deploy("cartpole", port=robot.port, policy=policy.path, out="runs/deployed")

Importing this package loads nothing else; a workflow loads what it needs when it is called. The parts live
in sub-packages: ``workflows`` (the Python API), ``control``, ``data``, ``sim``, ``viz``, ``testing``,
``drivers``, ``calib``, ``policies`` and ``cli``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from deal_hw.version import __version__ as __version__

if TYPE_CHECKING:
    from deal_hw.transport import WireOptions as WireOptions
    from deal_hw.workflows.calibrate import Calibration as Calibration
    from deal_hw.workflows.calibrate import calibrate as calibrate
    from deal_hw.workflows.collect import collect as collect
    from deal_hw.workflows.deploy import deploy as deploy
    from deal_hw.workflows.design_excitation import design_excitation as design_excitation
    from deal_hw.workflows.doctor.examine import doctor as doctor
    from deal_hw.workflows.emulate import EmulatedRobot as EmulatedRobot
    from deal_hw.workflows.emulate import emulate as emulate
    from deal_hw.workflows.inspect import Inspection as Inspection
    from deal_hw.workflows.inspect import inspect as inspect
    from deal_hw.workflows.own_robot.check import RobotCheck as RobotCheck
    from deal_hw.workflows.own_robot.check import check_robot as check_robot
    from deal_hw.workflows.own_robot.lock import LockedJoints as LockedJoints
    from deal_hw.workflows.own_robot.lock import lock_joints as lock_joints
    from deal_hw.workflows.own_robot.new import new_robot as new_robot
    from deal_hw.workflows.policy import PolicyReport as PolicyReport
    from deal_hw.workflows.policy import check_policy as check_policy
    from deal_hw.workflows.policy import import_policy as import_policy
    from deal_hw.workflows.replay import replay as replay
    from deal_hw.workflows.running.report import RunReport as RunReport
    from deal_hw.workflows.running.settings import B2LinkOptions as B2LinkOptions
    from deal_hw.workflows.running.settings import CraneOptions as CraneOptions
    from deal_hw.workflows.running.settings import G1LinkOptions as G1LinkOptions
    from deal_hw.workflows.running.settings import Go2LinkOptions as Go2LinkOptions
    from deal_hw.workflows.running.settings import LegOptions as LegOptions
    from deal_hw.workflows.running.settings import LinkOptions as LinkOptions
    from deal_hw.workflows.running.settings import SimulationOptions as SimulationOptions
    from deal_hw.workflows.stop import StopReport as StopReport
    from deal_hw.workflows.stop import stop as stop
    from deal_hw.workflows.train import Training as Training
    from deal_hw.workflows.train import train as train
    from deal_hw.workflows.train_seeds import SeedTrainings as SeedTrainings
    from deal_hw.workflows.train_seeds import train_seeds as train_seeds

_EXPORTS = {
    "workflows.calibrate": ("calibrate", "Calibration"),
    "workflows.collect": ("collect",),
    "workflows.deploy": ("deploy",),
    "workflows.doctor.examine": ("doctor",),
    "workflows.emulate": ("emulate", "EmulatedRobot"),
    "workflows.design_excitation": ("design_excitation",),
    "workflows.inspect": ("inspect", "Inspection"),
    "workflows.policy": ("import_policy", "check_policy", "PolicyReport"),
    "workflows.replay": ("replay",),
    "workflows.own_robot.check": ("check_robot", "RobotCheck"),
    "workflows.own_robot.lock": ("lock_joints", "LockedJoints"),
    "workflows.own_robot.new": ("new_robot",),
    "workflows.running.report": ("RunReport",),
    "workflows.running.settings": (
        "LinkOptions",
        "Go2LinkOptions",
        "B2LinkOptions",
        "G1LinkOptions",
        "LegOptions",
        "CraneOptions",
        "SimulationOptions",
    ),
    "workflows.stop": ("stop", "StopReport"),
    "workflows.train": ("train", "Training"),
    "workflows.train_seeds": ("train_seeds", "SeedTrainings"),
    "transport": ("WireOptions",),
}
"""Module -> names, imported on use."""
_MODULES = {name: f"deal_hw.{module}" for module, names in _EXPORTS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
