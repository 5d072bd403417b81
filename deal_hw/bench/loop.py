"""The loop bench: calibration, training, deployment on emulated cart-poles whose truth only the bench knows.

One row per seed and method, as the project's benchmark page defines them. Everything runs in virtual time
through the same driver, bytes, loop and recorder as on the wire.
"""

from __future__ import annotations

import itertools
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.bench.figures import draw
from deal_hw.bench.rows import Cells, RowTable, noted_in, per_parameter
from deal_hw.bench.scores import error_percent, fisher_std, interval_score, log_error_x100
from deal_hw.bench.settings import Loop
from deal_hw.bench.tables import line, print_summary
from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.pipeline.methods import check_method, is_default
from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import PolicyBehaviour
from deal_hw.parameters import ParameterDistribution
from deal_hw.policy import Policy
from deal_hw.workflows.calibration.intake import CalibrationInput
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.emulation.virtual import VirtualCartpole
from deal_hw.workflows.shipped import required_policy

if TYPE_CHECKING:
    from deal_hw.sim.engine.gpu import EngineName

TASK_EPISODES = 5
KEY = ("profile", "seed", "method", "range_ratio")


def calibration_row(
    case: Case, method: str, budget: Budget, threads: int | None, engine: EngineName = "mujoco"
) -> tuple[dict[str, Any], CalibrationResult]:
    """Calibrate with one method and score it.

    Returns:
        The calibration's part of the row, and the result.
    """
    from deal_hw.calib.validation.metrics import HeldOut

    d = case
    work = CalibrationInput(robot=d.robot, space=d.space, episodes=[d.fit], policy=d.policy)
    settings = CalibrateSettings(
        method=method,
        population=budget.population,
        generations=budget.generations,
        refine=budget.refine,
        seed=d.seed,
        threads=threads,
        engine=engine,
        starts="recorded",
    )
    result = calibrate_or_raise(settings, work, method)
    # Play in the gears may have become a parameter.
    found = result.restricted(d.space)
    coverage, width = _intervals(d, found, threads)
    truth = d.heldout_truth[:, d.heldout.channels[d.heldout.channels < d.heldout_truth.shape[1]]]
    held_out = HeldOut(d.robot, result.space, [d.heldout], threads=threads, truth=[truth])
    candidates = {"nominal": (result.space.nominal, 0.0), "calibrated": (result.estimate, result.latency_s)}
    errors = held_out.errors(candidates).nrmse
    verdicts = zip(d.space.names, found.verdicts, strict=False)
    untold = [name for name, verdict in verdicts if verdict == "not identifiable"]
    row = {
        "error_percent": error_percent(found.estimate, d.theta),
        "log_error_x100": log_error_x100(found.estimate, d.theta),
        "null_error_percent": error_percent(d.space.center, d.theta),
        "null_log_error_x100": log_error_x100(d.space.center, d.theta),
        "coverage90": coverage,
        "width90": width,
        "heldout_nrmse_nominal": errors["nominal"],
        "heldout_nrmse_calibrated": errors["calibrated"],
        "heldout_nrmse_null": errors["null"],
        "latency_true": d.latency_s,
        "latency_found": result.latency_s,
        "steps": result.steps,
        "seconds": result.seconds,
        "flagged": bool(result.alarms) or bool(untold),
        "chi2": result.chi2,
        "search": result.provenance.get("search", ""),
        "alarms": [str(alarm) for alarm in result.alarms],
        "untold": untold,
        "null_directions": list(result.null_directions),
        "per_parameter": per_parameter(found, d.theta),
        "refused_truths": d.refused,
        "excitation_levels": list(d.excitation_levels),
    }
    return row, result


def _intervals(case: Case, result: CalibrationResult, threads: int | None) -> tuple[float, float | None]:
    """Return coverage90 and width90; without noise there is no bound for a width."""
    from deal_hw.calib.data.parts import samples_in
    from deal_hw.calib.data.problem import Problem

    if case.channel_std is None:
        inside = (result.interval[:, 0] <= case.theta) & (case.theta <= result.interval[:, 1])
        return float(np.mean(inside)), None
    problem = Problem(case.robot, case.space, [case.fit], threads=threads)
    std = np.maximum(case.channel_std, problem.noise_std[problem.channels] * 1e-2)
    length = samples_in(problem, 0.8)
    bound = fisher_std(problem, case.theta, case.latency_s, [case.fit_truth], std, length)
    return interval_score(case.space, result.interval, case.theta, bound)


def task_score(truth: CartpoleTruth, policy: Policy) -> tuple[float, float]:
    """Run the fixed task on the emulated robot; return mean |pole angle| [rad] and mean |cart speed| [m/s].

    After an early end by the safety filter, the rest counts as fallen: pi rad, and a cart at rest.
    """
    from deal_hw.motions.scores.balance import TASK_SECONDS, balance_result

    virtual = VirtualCartpole(truth)
    angles, speeds = [], []
    for _ in range(TASK_EPISODES):
        run = virtual.run(PolicyBehaviour(policy, DESCRIPTION), TASK_SECONDS)
        recorded, period_s = run.trajectory, 1 / DESCRIPTION.state_rate_hz
        result = balance_result(recorded.position, recorded.velocity, period_s, TASK_SECONDS)
        angles.append(result.angle_error_rad)
        speeds.append(result.cart_speed_m_s)
    return float(np.mean(angles)), float(np.mean(speeds))


def transfer_row(case: Case, result: CalibrationResult, folder: Path) -> dict[str, Any]:
    """Train under the calibrated distribution and under the truth; deploy both and the shipped UDR policy.

    Returns:
        The policies' part of the row.
    """
    from deal_hw.policies.onnx_runtime import OnnxPolicy
    from deal_hw.workflows.train import train_policy

    d, truth = case, case.truth
    if truth is None:
        raise ConfigurationError(f"{case.task} has no emulator to deploy on; only the cart-pole has")
    row: dict[str, Any] = {}
    shipped = OnnxPolicy(required_policy("cartpole"))
    row["angle_error_udr"], row["cart_speed_udr"] = task_score(truth, shipped)
    oracle = ParameterDistribution.point(d.space, d.theta, d.latency_s)
    for name, distribution in (("retrained", result.distribution()), ("oracle", oracle)):
        start = time.perf_counter()
        file = folder / f"{d.profile}_{d.seed}_{name}.onnx"
        train_policy("cartpole", distribution, file, seed=d.seed)
        if name == "retrained":
            row["seconds_train"] = time.perf_counter() - start
        row[f"angle_error_{name}"], row[f"cart_speed_{name}"] = task_score(truth, OnnxPolicy(file))
    return row


def table(settings: Loop) -> RowTable:
    """Return the bench: its cells, seed by seed, by :func:`loop_row`.

    Raises:
        UnknownNameError: There is no such method.
    """
    for method in settings.methods:
        check_method(method)
    run = partial(
        loop_row,
        range_ratio=settings.range_ratio,
        train=settings.train,
        folder=settings.beside("policies"),
        threads=settings.cell_threads,
    )
    args = [
        (
            (settings.profile, seed, method, settings.range_ratio),
            (settings.profile, seed, method),
        )
        for seed, method in itertools.product(settings.seeds, settings.methods)
    ]
    cells = Cells(names=KEY, run=run, args=args, tasks=settings.tasks(), bench=settings.name)
    return RowTable(cells=cells, line=line, summary=print_summary, draw=draw)


def loop_row(
    profile: str,
    seed: int,
    method: str,
    range_ratio: float,
    *,
    train: bool,
    folder: Path,
    threads: int | None,
) -> dict[str, Any]:
    """Run one cell; an error goes into the row, so that the other cells still run.

    Args:
        profile: Profile of the emulated robot.
        seed: Seed of its truth.
        method: "default" is refined and, with ``train``, trained and deployed; the others are not.
        range_ratio: Ratio of the search range.
        train: Whether the default trains and deploys policies.
        folder: Folder of the policies.
        threads: Simulation threads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    refine = is_default(method)
    row: dict[str, Any] = {
        "bench": "loop",
        "task": "cartpole",
        "profile": profile,
        "method": method,
        "refined": refine,
        "range_ratio": range_ratio,
        "seed": seed,
        "error": "",
    }
    with noted_in(row):
        case = make_case("cartpole", profile, seed, range_ratio)
        part, result = calibration_row(case, method, Budget(refine=refine), threads)
        row |= part
        if refine and train:
            row |= transfer_row(case, result, folder)
    return row
