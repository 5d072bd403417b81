"""The loop bench: calibration, training, deployment on emulated cart-poles whose truth only it knows.

One row a seed and method, as the project's benchmark page defines them. Everything runs in virtual time
through the same driver, bytes, loop and recorder as on the wire.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.cli.calibrate import calibrate_episodes
from deal_hw.cli.run_plan import Profile, RunPlan, make_behaviour, shipped_policy
from deal_hw.cli.virtual import VirtualCartpole
from deal_hw.control.behaviours import PolicyBehaviour
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.oracle import draw_truth
from deal_hw.drivers.cartpole.profiles import profile as find_profile
from deal_hw.drivers.cartpole.truth import Truth
from deal_hw.errors import DealHwError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.policy import Policy
from deal_hw.sim.episode import Episode, align, fill_gaps
from deal_hw.sim.model import RobotModel, load_model
from deal_hw.types import FloatArray

DEMONSTRATION_S = 4.0
TASK_EPISODES = 5
SEARCHES = ("deal", "weki", "deal-paper", "deal-paper-flat", "centre")
"""Run without the polish, beside the default with everything."""


@dataclass(frozen=True, slots=True)
class Demonstration:
    """What a seed's robot gave, and what only the bench knows.

    Attributes:
        truth: The hidden truth.
        space: What is searched.
        robot: The nominal model.
        theta: True values of the free parameters, (K,).
        fit: The demonstration.
        heldout: Another motion family.
        fit_truth: Noise-free positions and velocities at the demonstration's samples.
        heldout_truth: Noise-free positions at the held-out samples.
    """

    truth: Truth
    space: ParameterSpace
    robot: RobotModel
    theta: FloatArray
    fit: Episode
    heldout: Episode
    fit_truth: tuple[FloatArray, FloatArray]
    heldout_truth: FloatArray


def demonstrate(profile: str, seed: int, xi: float) -> Demonstration:
    """Draw a truth and record one ``rich`` demonstration and one ``chirp`` from its robot."""
    truth = draw_truth(profile, seed, xi=xi)
    space = k9_space().with_ratio(xi)
    virtual = VirtualCartpole(truth)
    recordings = []
    policy = str(shipped_policy("cartpole") or "")
    kinds: tuple[Profile, ...] = ("rich", "chirp")
    for kind in kinds:
        plan = RunPlan(robot="cartpole", profile=kind, seconds=DEMONSTRATION_S, seed=seed, policy=policy)
        recordings.append(virtual.run(make_behaviour(plan, DESCRIPTION), DEMONSTRATION_S))
    fit, heldout = (fill_gaps(align(r.trajectory, DESCRIPTION)) for r in recordings)
    return Demonstration(
        truth=truth,
        space=space,
        robot=load_model(DESCRIPTION),
        theta=np.array([truth.parameters[name] for name in space.names]),
        fit=fit,
        heldout=heldout,
        fit_truth=recordings[0].true_states(fit),
        heldout_truth=recordings[1].true_states(heldout)[0],
    )


def calibration_row(
    demonstration: Demonstration, method: str, budget: Budget, threads: int | None
) -> tuple[dict[str, Any], CalibrationResult]:
    """Calibrate with one method and score it.

    Returns:
        The row's part that concerns calibration, and the result.
    """
    from deal_hw.calib.metrics import error_percent, fisher_std, interval_score, log_error_x100
    from deal_hw.calib.problem import Problem
    from deal_hw.calib.validate import heldout_nrmse

    d = demonstration
    result = calibrate_episodes(
        d.robot, d.space, [d.fit], [], method=method, budget=budget, rng=np.random.default_rng(d.truth.seed),
        threads=threads,
    )  # fmt: skip
    problem = Problem(d.robot, d.space, [d.fit], threads=threads)
    sensor = find_profile(d.truth.profile).sensor
    bound = fisher_std(
        problem, d.theta, d.truth.latency_s, [d.fit_truth],
        np.maximum(sensor.position_std, problem.noise_std[problem.channels] * 1e-2), length=160,
    )  # fmt: skip
    score = interval_score(d.space, result.interval, d.theta, bound)
    errors = heldout_nrmse(
        d.robot, d.space, [d.heldout],
        {"nominal": (d.space.nominal, 0.0), "calibrated": (result.estimate, result.latency_s)},
        truth=[d.heldout_truth], threads=threads,
    )  # fmt: skip
    row = {
        "error_percent": error_percent(result.estimate, d.theta),
        "log_error_x100": log_error_x100(result.estimate, d.theta),
        "null_error_percent": error_percent(d.space.center, d.theta),
        "null_log_error_x100": log_error_x100(d.space.center, d.theta),
        "coverage90": score.coverage90,
        "width90": score.width90,
        "heldout_nrmse_nominal": errors["nominal"],
        "heldout_nrmse_calibrated": errors["calibrated"],
        "heldout_nrmse_null": errors["null"],
        "latency_true": d.truth.latency_s,
        "latency_found": result.latency_s,
        "steps": result.steps,
        "seconds": result.seconds,
        "flagged": bool(result.alarms),
        "chi2": result.chi2,
        "alarms": list(result.alarms),
        "per_parameter": {
            p.name: {
                "truth": float(d.theta[k]),
                "estimate": float(result.estimate[k]),
                "low": float(result.interval[k, 0]),
                "high": float(result.interval[k, 1]),
            }
            for k, p in enumerate(d.space)
        },
        "refused_truths": d.truth.refused,
    }
    return row, result


def task_score(truth: Truth, policy: Policy, episodes: int = TASK_EPISODES) -> tuple[float, float]:
    """Run the frozen task on the emulated robot; return mean |pole angle| [rad] and mean |cart speed| [m/s].

    A run that the safety filter ended early counts as fallen over the rest: pi rad, and a cart at rest.
    """
    from deal_hw.policies.evaluate import TASK_SECONDS, balance_result

    virtual = VirtualCartpole(truth)
    angles, speeds = [], []
    for _ in range(episodes):
        run = virtual.run(PolicyBehaviour(policy, DESCRIPTION), TASK_SECONDS)
        recorded, period_s = run.trajectory, 1 / DESCRIPTION.state_rate_hz
        result = balance_result(recorded.position, recorded.velocity, period_s, TASK_SECONDS)
        angles.append(result.angle_error_rad)
        speeds.append(result.cart_speed_m_s)
    return float(np.mean(angles)), float(np.mean(speeds))


def transfer_row(demonstration: Demonstration, result: CalibrationResult, folder: Path) -> dict[str, Any]:
    """Train under the calibrated distribution and under the truth, deploy both and the shipped UDR policy.

    Args:
        demonstration: The robot.
        result: Its calibration.
        folder: Where the policies are kept.

    Returns:
        The row's part that concerns the policies.
    """
    from deal_hw.cli.train import train_policy
    from deal_hw.policies.onnx_runtime import OnnxPolicy

    d = demonstration
    row: dict[str, Any] = {}
    shipped = shipped_policy("cartpole")
    if shipped is None:
        raise DealHwError("no UDR policy is shipped for the cart-pole; tools/train_udr_policy.py makes it")
    row["angle_error_udr"], row["cart_speed_udr"] = task_score(d.truth, OnnxPolicy(shipped))
    oracle = ParameterDistribution.point(d.space, d.theta, d.truth.latency_s)
    for name, distribution in (("retrained", result.distribution()), ("oracle", oracle)):
        start = time.perf_counter()
        file = folder / f"{d.truth.profile}_{d.truth.seed}_{name}.onnx"
        train_policy("cartpole", distribution, file, seed=d.truth.seed)
        if name == "retrained":
            row["seconds_train"] = time.perf_counter() - start
        row[f"angle_error_{name}"], row[f"cart_speed_{name}"] = task_score(d.truth, OnnxPolicy(file))
    return row


def loop_cells(methods: Sequence[str], seeds: Sequence[int]) -> list[tuple[int, str]]:
    """Return the cells of the bench, seed by seed."""
    return [(seed, method) for seed in seeds for method in methods]


def loop_row(
    profile: str, seed: int, method: str, xi: float, *, train: bool, folder: Path, threads: int | None
) -> dict[str, Any]:
    """Run one cell; an error is kept in the row, so that the other cells still run.

    Args:
        profile: Profile of the emulated robot.
        seed: Seed of its truth.
        method: "default" is polished and, where asked, trained and deployed; the others run without polish.
        xi: Ratio of the search range.
        train: Whether the default trains and deploys policies.
        folder: Where policies go.
        threads: Simulation threads.
    """
    polish = method == "default"
    row: dict[str, Any] = {
        "bench": "loop", "task": "cartpole", "profile": profile, "method": method, "polish": polish, "xi": xi,
        "seed": seed, "error": "",
    }  # fmt: skip
    try:
        demonstration = demonstrate(profile, seed, xi)
        part, result = calibration_row(demonstration, method, Budget(polish=polish), threads)
        row |= part
        if polish and train:
            row |= transfer_row(demonstration, result, folder)
    except DealHwError as err:
        row["error"] = f"{type(err).__name__}: {err}"
    return row
