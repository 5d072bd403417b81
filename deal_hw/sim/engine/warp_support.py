"""What MuJoCo Warp needs, and what it lacks: checked before a run, without loading it."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import TypeAlias

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.gpu import EngineName, WantedEngine, gpu_problem
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.engine.transmission import check_engine

Say: TypeAlias = Callable[[str], None]

LEAST_MEMBERS = 64
"""Fewest members for which ``auto`` takes a GPU: of a search, each of which is simulated in tens of windows
at once, or of a training, which takes one CPU core without a GPU. A choice: no rows of a GPU are kept
(docs/how-to/gpu.md)."""

_INSTEAD = "use --engine mujoco"

PACKAGES = {"warp": "warp-lang", "mujoco_warp": "mujoco-warp"}
"""Modules of the extra, and the distributions that have them."""

_ACTUATORS = {
    "dynamics": ("actuator_dyntype", "mjDYN", "NONE INTEGRATOR FILTER FILTEREXACT MUSCLE DCMOTOR"),
    "gain": ("actuator_gaintype", "mjGAIN", "FIXED AFFINE MUSCLE DCMOTOR"),
    "bias": ("actuator_biastype", "mjBIAS", "NONE AFFINE MUSCLE DCMOTOR"),
}
"""What actuators can do in MuJoCo Warp 4.0.0, but for callbacks in Python."""


def missing_features(model: mujoco.MjModel) -> list[str]:
    """Return what a model has and MuJoCo Warp 4.0.0 lacks, in words; empty where it can be simulated."""
    found = []
    for what, (field, prefix, known) in _ACTUATORS.items():
        kinds = {"DYN": mujoco.mjtDyn, "GAIN": mujoco.mjtGain, "BIAS": mujoco.mjtBias}[prefix[2:]]
        able = [int(getattr(kinds, f"{prefix}_{name}")) for name in known.split()]
        for number in np.flatnonzero(~np.isin(getattr(model, field), able)):
            kind = kinds(int(getattr(model, field)[number])).name.removeprefix(f"{prefix}_").lower()
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, int(number))
            found.append(f"actuator {name or number} has {what} {kind}")
    for element in ("body", "actuator", "sensor", "geom"):
        if np.any(np.asarray(getattr(model, f"{element}_plugin")) != -1):
            found.append(f"a plugin of a {element}")
    if np.any(np.asarray(model.actuator_delay) > 0):
        found.append("delays of actuators in the MJCF, whose history it does not keep from window to window")
    if model.nflex:
        found.append("flexes")
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        found.append("solver PGS")
    if model.opt.noslip_iterations > 0 and model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        found.append("noslip with the integrator discrete")
    if model.nv > 60 and model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE:
        found.append(f"a dense Jacobian of {model.nv} degrees of freedom (60 at most)")
    return found


def check_model(model: mujoco.MjModel, name: str = "the model") -> None:
    """Refuse a model that MuJoCo Warp cannot simulate.

    Raises:
        ConfigurationError: Names every feature that it lacks.
    """
    found = missing_features(model)
    if found:
        raise ConfigurationError(
            f"MuJoCo Warp cannot simulate {name}: it has {'; '.join(dict.fromkeys(found))}; remove that from "
            f"the MJCF, or {_INSTEAD}"
        )


def check_installed() -> None:
    """Refuse where MuJoCo Warp is not installed.

    Raises:
        MissingExtraError: It is not.
    """
    for package, name in PACKAGES.items():
        if find_spec(package) is None:
            raise MissingExtraError(name, "gpu")


def check_gpu() -> None:
    """Refuse where there is no GPU.

    Raises:
        ConfigurationError: Says what was found and what to do.
    """
    problem = gpu_problem()
    if problem:
        raise ConfigurationError(
            f"--engine warp needs a GPU, and {problem}; look at `nvidia-smi`, or {_INSTEAD}. To try it "
            "without one, --engine warp-cpu is far slower than mujoco"
        )


def choose_engine(
    wanted: WantedEngine,
    robot: RobotModel,
    members: int,
    what: str,
    say: Say,
    without: str = "",
    space: ParameterSpace | None = None,
) -> EngineName:
    """Return what simulates many members, and say it.

    Args:
        wanted: What was asked for.
        robot: The robot; all its set-ups are checked.
        members: Members: of a search's population, or of a training.
        what: What is simulated, in words: "the search".
        say: Called with a sentence.
        without: Name of the method where it has no search that another engine can simulate; else "".
        space: The parameters, if they are known.

    Raises:
        ConfigurationError: The engine that was asked for cannot simulate this model, parameter, search or
            population.
        MissingExtraError: MuJoCo Warp was asked for, and is not installed.
    """
    if wanted == "mujoco":
        return "mujoco"
    try:
        if without:
            raise ConfigurationError(
                f"--engine {wanted} simulates the populations of --search deal, eki and deal-paper, and the "
                f"method {without} has none; leave it out"
            )
        for name, model in {"": robot, **robot.setups}.items():
            check_model(model.model, f"the set-up {name}" if name else "the model")
        if space is not None:
            check_engine(space, "warp")
        check_installed()
        if wanted != "warp-cpu":
            check_gpu()
        if wanted == "auto" and members < LEAST_MEMBERS:
            raise ConfigurationError(f"{members} members are too few for a GPU (fewer than {LEAST_MEMBERS})")
    except (ConfigurationError, MissingExtraError) as err:
        if wanted != "auto":
            raise
        say(f"mujoco simulates {what}: {err}")
        return "mujoco"
    if wanted == "warp-cpu":
        say(
            f"MuJoCo Warp simulates {what} on a CPU, far slower than mujoco; its kernels are compiled first, "
            "which takes minutes"
        )
        return "warp-cpu"
    say(f"MuJoCo Warp simulates {what} on the GPU, in float32")
    return "warp"
